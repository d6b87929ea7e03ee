"""Bags of ROS 1 as rosbag leaves them when it is killed, and truncated ones."""

import struct
from pathlib import Path

import pytest
from rosbags.rosbag1 import Writer as Ros1Writer

from service.errors import InputError
from service.recording.opening import open_recording
from tests.service.recording.bags import write_ros1
from tests.service.recording.sessions import drive

DRIVE = drive(30)
NONE, BZ2, LZ4 = None, Ros1Writer.CompressionFormat.BZ2, Ros1Writer.CompressionFormat.LZ4
_CHUNK = b"op=\x05"


def field(data: bytes, name: bytes, begin: int) -> int:
    """Where the value of a header's field stands."""
    return data.index(name + b"=", begin) + len(name) + 1


def chunks(data: bytes) -> list[int]:
    """Where the headers of the chunks begin."""
    found, at = [], -1
    while (at := data.find(_CHUNK, at + 1)) >= 0:
        found.append(next(begin for begin in range(at - 4, 0, -1) if is_header(data, begin, at)))
    return found


def is_header(data: bytes, begin: int, around: int) -> bool:
    """Whether a record begins there whose first field does, too, and that reaches beyond `around`."""
    size, first = struct.unpack_from("<II", data, begin)
    return around - begin < size < 200 and 3 < first < 40 and data[begin + 8 : begin + 8 + first].isascii()


def killed(path: Path, data: bytes, left_of_chunk: float) -> int:
    """Write what rosbag has written when it is killed with its last chunk open; bytes of that chunk."""
    index_at = field(data, b"index_pos", 0)
    (index_pos,) = struct.unpack_from("<Q", data, index_at)
    last = chunks(data)[-1]
    (header,) = struct.unpack_from("<I", data, last)
    data_at = last + 4 + header
    (size,) = struct.unpack_from("<I", data, data_at)
    bag = bytearray(data[: data_at + 4 + int(size * left_of_chunk)])
    bag[index_at : index_at + 8] = bytes(8)
    for name in (b"conn_count", b"chunk_count"):
        at = field(data, name, 0)
        bag[at : at + 4] = bytes(4)
    at = field(data, b"size", last)
    bag[at : at + 4] = bag[data_at : data_at + 4] = bytes(4)
    path.write_bytes(bag)
    assert index_pos > last
    return len(bag) - data_at - 4


@pytest.mark.parametrize("name", ["drive.bag.active", "drive.bag"])
@pytest.mark.parametrize(("compression", "least"), [(NONE, 0.7), (LZ4, 0.5), (BZ2, 0.5)], ids=str)
def test_a_bag_that_was_never_closed_is_read_up_to_where_its_writer_died(name, compression, least, tmp_path):
    whole = write_ros1(tmp_path / "whole.bag", DRIVE, compression, chunk_bytes=60_000).read_bytes()
    path = tmp_path / name
    killed(path, whole, 0.6)
    before = path.read_bytes()
    recording = open_recording([path])
    read = list(recording.messages())
    assert [m.payload for m in read] == [m.payload for m in DRIVE[: len(read)]]
    assert least * len(DRIVE) < len(read) < len(DRIVE)
    assert sum(topic.count for topic in recording.topics) == len(read)
    assert (recording.first_log_ns, recording.last_log_ns) == (read[0].log_ns, read[-1].log_ns)
    (loss,) = recording.losses
    assert f"{path} was not closed, or is cut off or damaged: " in loss
    assert f"{len(read)} messages of " in loss
    assert "bytes that are cut off at its end" in loss
    assert path.read_bytes() == before


def test_a_bag_cut_off_anywhere_is_read_as_far_as_it_goes_or_refused(tmp_path):
    whole = write_ros1(tmp_path / "whole.bag", DRIVE).read_bytes()
    counts = []
    for share in range(3, 20):
        path = tmp_path / f"{share}.bag"
        path.write_bytes(whole[: len(whole) * share // 20])
        recording = open_recording([path])
        read = list(recording.messages())
        assert [m.payload for m in read] == [m.payload for m in DRIVE[: len(read)]]
        assert f"{len(read)} message" in recording.losses[0]
        counts.append(len(read))
    assert counts == sorted(counts)
    path.write_bytes(whole[:5000])
    with pytest.raises(InputError, match=r"cannot be read as a ROS 1 bag"):
        open_recording([path])


@pytest.mark.parametrize("compression", [LZ4, BZ2], ids=str)
def test_a_damaged_chunk_of_a_bag_without_index_costs_itself_only(compression, tmp_path):
    data = write_ros1(tmp_path / "whole.bag", DRIVE, compression).read_bytes()
    path = tmp_path / "killed.bag"
    killed(path, data, 1.0)
    bag = bytearray(path.read_bytes())
    second = chunks(data)[1]
    bag[second + 200 : second + 2000] = bytes(1800)
    path.write_bytes(bag)
    recording = open_recording([path])
    payloads = [m.payload for m in recording.messages()]
    assert len(DRIVE) // 2 < len(payloads) < len(DRIVE)
    assert set(payloads) < {m.payload for m in DRIVE}
    assert "lost: 1 damaged chunk" in recording.losses[0]
