import fcntl

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from service.errors import CorridorError, InputError
from service.recording import mcap_recovery
from service.recording.mcap_reader import Recording
from service.recording.mcap_recovery import recover, recover_leftovers
from tests.service.recording.sessions import as_read, drive, read_back, write_file

SYNCED = 50  # messages in each chunk of the files below


@pytest.fixture
def active(tmp_path):
    """A file whose writer died after six chunks, and what was put into them."""
    path = tmp_path / "s_0001.mcap"
    written = write_file(path, drive(160)[:320], sync_every=SYNCED, finish=False)
    return path.with_name(path.name + ".active"), written[:300]


def damage(path, offset, change=lambda byte: byte ^ 0xFF):
    data = bytearray(path.read_bytes())
    data[offset] = change(data[offset])
    path.write_bytes(data)


def chunk_offsets(path):
    """Where the chunks of a file begin: by their compression's name, 37 bytes in."""
    data, offsets, at = path.read_bytes(), [], 0
    while (at := data.find(b"\x04\x00\x00\x00zstd", at + 1)) >= 0:
        offsets.append(at - 37)
    return [offset for offset in offsets if data[offset] == 6]


def test_a_dead_writers_file_becomes_a_session(active):
    path, synced = active
    report = recover(path)
    assert report.path.name == "s_0001.mcap"
    assert report.messages == len(synced)
    assert (report.bad_chunks, report.skipped_bytes, report.orphans) == (0, 0, 0)
    assert (report.first_log_ns, report.last_log_ns) == (synced[0].log_ns, synced[-1].log_ns)
    assert read_back(report.path) == as_read(synced)
    assert Recording([report.path]).metadata == {"config": {"vehicle": "test"}}
    assert list(path.parent.iterdir()) == [report.path]
    assert "300 messages over 3.0 s" in str(report)


@pytest.mark.parametrize("name", ["s_0001.mcap.bak", "s_0001.active", "s_0001"])
def test_a_file_of_another_name_is_refused_with_the_name_it_needs(active, name):
    path, _ = active
    renamed = path.rename(path.with_name(name))
    before = renamed.read_bytes()
    with pytest.raises(InputError, match=r"called NAME\.mcap, or NAME\.mcap\.active .*; rename it"):
        recover(renamed)
    assert (list(path.parent.iterdir()), renamed.read_bytes()) == ([renamed], before)


def test_any_truncation_keeps_every_whole_chunk_and_more(active):
    path, synced = active
    whole = path.read_bytes()
    ends = chunk_offsets(path)[1:]
    for end in np.random.default_rng(5).integers(ends[0], len(whole), 12).tolist():
        path.write_bytes(whole[:end])
        report = recover(path)
        complete = sum(chunk_end <= end for chunk_end in ends) * SYNCED
        assert complete <= report.messages <= len(synced)
        assert read_back(report.path) == as_read(synced[: report.messages])
        report.path.unlink()


def test_whole_messages_of_a_cut_chunk_are_kept(tmp_path):
    """A chunk of 1 MiB holds many zstd blocks; those before the cut still decompress."""
    path = tmp_path / "s_0001.mcap"
    written = write_file(path, drive(400), sync_every=10_000)
    data = path.read_bytes()
    (begin, *_) = chunk_offsets(path)
    path.write_bytes(data[: begin + 400_000])
    report = recover(path)
    assert 100 < report.messages < len(written)
    assert read_back(report.path) == as_read(written[: report.messages])


@pytest.mark.parametrize("compression", CompressionType)
def test_whole_messages_of_a_cut_chunk_of_another_recorder_are_kept(tmp_path, compression):
    """`ros2 bag record` compresses by nothing, lz4 or zstd, as it is set."""
    path = tmp_path / "s_0001.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2_000_000, compression=compression)
        writer.start("ros2", "another recorder")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/words", "cdr", schema)
        for k in range(400):
            words = np.random.default_rng(k).bytes(1_000).hex().encode()
            payload = b"\0\1\0\0" + (len(words) + 1).to_bytes(4, "little") + words + b"\0"
            writer.add_message(channel, k, payload, k)
        writer.finish()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert 100 < recover(path).messages < 300


def test_a_flipped_byte_costs_one_chunk(active):
    path, synced = active
    third = chunk_offsets(path)[2]
    damage(path, third + 5_000)
    report = recover(path)
    assert (report.bad_chunks, report.messages) == (1, len(synced) - SYNCED)
    assert read_back(report.path) == as_read(synced[:100] + synced[150:])
    assert report.kept_original == path.with_name("s_0001.mcap.damaged")
    assert report.kept_original.exists()
    assert "lost 1 damaged chunk and" in str(report)


@pytest.mark.parametrize("field", [0, 1, 4, 8], ids=["opcode", "length", "length by 4 GB", "length by 2**56"])
def test_a_record_that_lies_about_itself_costs_one_chunk_at_most(active, field):
    path, synced = active
    third = chunk_offsets(path)[2]
    damage(path, third + field, lambda byte: (byte + 1) % 256)
    report = recover(path)
    assert len(synced) - SYNCED <= report.messages <= len(synced)
    assert read_back(report.path)[:100] == as_read(synced[:100])


def test_random_damage_never_crashes_nor_invents_messages(active):
    path, synced = active
    whole = path.read_bytes()
    known = set(as_read(synced))
    end_of_first_chunk = chunk_offsets(path)[1]
    rng, refused = np.random.default_rng(6), 0
    for _ in range(30):
        data, places = bytearray(whole), rng.integers(8, len(whole), 3).tolist()
        for at in places:
            data[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            report = recover(path)
        except CorridorError:
            assert min(places) < end_of_first_chunk  # which names the channels
            refused += 1
            continue
        rows = read_back(report.path)
        assert set(rows) <= known
        assert len(rows) >= len(synced) - 3 * SYNCED
        report.path.unlink()
        path.with_name("s_0001.mcap.damaged").unlink(missing_ok=True)
    assert 0 < refused < 30


def test_without_the_first_chunk_and_the_index_nothing_can_be_named(active):
    path, _ = active
    before = path.read_bytes()
    damage(path, chunk_offsets(path)[0] + 5_000)
    with pytest.raises(InputError, match="holds no message that can be read"):
        recover(path)
    assert len(path.read_bytes()) == len(before)
    assert list(path.parent.iterdir()) == [path]


def test_a_complete_file_is_left_alone(tmp_path):
    path = tmp_path / "s_0001.mcap"
    write_file(path, drive(30))
    before = path.read_bytes()
    report = recover(path)
    assert report.complete
    assert report.messages == 61
    assert path.read_bytes() == before
    assert "nothing to do" in str(report)


def test_a_recovery_that_was_killed_midway_is_done_again(active):
    path, synced = active
    folder = path.with_name("s_0001.mcap.recovering")
    folder.mkdir()
    (folder / "s_0001.mcap").write_bytes(b"half")
    assert recover(path).messages == len(synced)
    assert not folder.exists()


def test_another_file_of_that_name_is_not_overwritten(active, tmp_path):
    path, _ = active
    other = tmp_path / "s_0001.mcap"
    write_file(other.with_name("x.mcap"), drive(5))
    other.with_name("x.mcap").rename(other)
    before = other.read_bytes()
    with pytest.raises(CorridorError, match="exists and differs"):
        recover(path)
    assert other.read_bytes() == before
    assert path.exists()


def test_a_file_that_is_being_written_is_refused(active):
    path, _ = active
    with path.open("rb") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="in use"):
            recover(path)


def test_a_leftover_that_another_began_to_recover_meanwhile_is_left_to_it(active, monkeypatch):
    path, _ = active
    monkeypatch.setattr(mcap_recovery, "is_locked", lambda path: False)  # it was not, a moment ago
    with path.open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        recover_leftovers([path])
    assert list(path.parent.iterdir()) == [path]


def test_a_file_that_another_service_writes_is_left_to_it_with_a_warning(tmp_path, caplog):
    path = tmp_path / "veh2.mcap.active"
    with path.open("wb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        recover_leftovers([path])
    assert path.exists()
    assert f"{path} is being written: another service has this recording.directory, too" in caplog.text


def test_an_empty_leftover_is_removed(tmp_path):
    path = tmp_path / "x.mcap.active"
    path.touch()
    recover_leftovers([path])
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_mcap_is_refused_with_what_was_found(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_text("hello, this is text")
    with pytest.raises(InputError, match="is not an MCAP file: it begins with 68 65 6c"):
        recover(path)
    with pytest.raises(InputError, match="No such file"):
        recover(tmp_path / "missing.mcap.active")


def test_a_file_that_is_not_ros_2_is_refused(tmp_path):
    path = tmp_path / "foreign.mcap.active"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="protobuf", library="other")
        writer.flush()
    with pytest.raises(InputError, match='profile "protobuf"'):
        recover(path)
