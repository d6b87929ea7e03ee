"""One drive in every container is mapped to the same poses; what is broken is refused in words."""

import bz2
import gzip
import lzma
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from service.cli import main
from service.errors import InputError, StorageError
from service.offline.replay.replay import group_sessions
from service.recording.mcap_source import open_session
from service.recording.opening import open_recording
from service.recording.unpacking import Unpacked
from tests.service.recording.bags import write_ros1, write_ros1_mcap, write_ros2
from tests.service.recording.sessions import drive, write_file

SCANS = 30
DRIVE = drive(SCANS)
BZ2, LZ4 = Ros1Writer.CompressionFormat.BZ2, Ros1Writer.CompressionFormat.LZ4
ZSTD = zstandard.ZstdCompressor()


def packed(path: Path, suffix: str, pack: Callable[[bytes], bytes]) -> Path:
    """The file packed, in a folder of its own."""
    made = path.parent / "packed" / (path.name + suffix)
    made.parent.mkdir()
    made.write_bytes(pack(path.read_bytes()))
    return made


def only_file(folder: Path) -> Path:
    (file,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    return file


def mcap(folder: Path) -> Path:
    write_file(folder / "drive.mcap", DRIVE)
    return folder / "drive.mcap"


def db3(folder: Path) -> Path:
    return only_file(write_ros2(folder / "drive", DRIVE))


def killed_ros2_folder(folder: Path) -> Path:
    """Of `ros2 bag record`, which writes metadata.yaml last; in two files."""
    killed = folder / "drive"
    killed.mkdir()
    for k, part in enumerate((DRIVE[:20], DRIVE[20:])):
        shutil.copy(only_file(write_ros2(folder / f"part{k}", part)), killed / f"drive_{k}.db3")
    return killed


def played_ros2_folder(folder: Path) -> Path:
    """`ros2 bag play` leaves what it has unpacked beside the packed file."""
    bag = write_ros2(folder / "drive", DRIVE, compression=CompressionMode.FILE)
    unpacked = Unpacked(only_file(bag))
    unpacked.given.with_suffix("").write_bytes(unpacked.path.read_bytes())
    return bag


def with_sqlite_log(folder: Path) -> Path:
    """A db3 whose writer died: the last rows are in the log beside it."""
    path = db3(folder)
    with sqlite3.connect(path) as database:
        rows = database.execute("SELECT topic_id, timestamp, data FROM messages WHERE id > 20").fetchall()
        database.execute("DELETE FROM messages WHERE id > 20")
    database.close()
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode=WAL")
    writer.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    writer.commit()
    died = folder / "died"
    died.mkdir()
    for file in (path, path.with_name(path.name + "-wal")):
        shutil.copy(file, died)
    writer.close()
    return died / path.name


CONTAINERS: dict[str, Callable[[Path], Path]] = {
    "bag": lambda f: write_ros1(f / "drive.bag", DRIVE),
    "bag of bz2 chunks": lambda f: write_ros1(f / "drive.bag", DRIVE, BZ2),
    "bag of lz4 chunks": lambda f: write_ros1(f / "drive.bag", DRIVE, LZ4),
    "bag.gz": lambda f: packed(write_ros1(f / "drive.bag", DRIVE), ".gz", gzip.compress),
    "bag.lz4": lambda f: packed(write_ros1(f / "drive.bag", DRIVE), ".lz4", lz4.frame.compress),
    "bag of another name": lambda f: write_ros1(f / "drive.bag", DRIVE).rename(f / "drive.orig"),
    "db3": db3,
    "db3 with a special name": lambda f: db3(f).rename(f / "drive #1?.db3"),
    "db3 with a log": with_sqlite_log,
    "db3.zstd": lambda f: packed(db3(f), ".zstd", ZSTD.compress),
    "ROS 2 folder": lambda f: write_ros2(f / "drive", DRIVE),
    "ROS 2 folder, mcap": lambda f: write_ros2(f / "drive", DRIVE, StoragePlugin.MCAP),
    "ROS 2 folder, file mode": lambda f: write_ros2(f / "drive", DRIVE, compression=CompressionMode.FILE),
    "ROS 2 folder, message mode": lambda f: write_ros2(
        f / "drive", DRIVE, compression=CompressionMode.MESSAGE
    ),
    "ROS 2 folder, mcap, file mode": lambda f: write_ros2(
        f / "drive", DRIVE, StoragePlugin.MCAP, CompressionMode.FILE
    ),
    "ROS 2 folder, mcap, message mode": lambda f: write_ros2(
        f / "drive", DRIVE, StoragePlugin.MCAP, CompressionMode.MESSAGE
    ),
    "ROS 2 folder, killed": killed_ros2_folder,
    "ROS 2 folder, played": played_ros2_folder,
    "mcap of ROS 1": lambda f: write_ros1_mcap(f / "drive.mcap", DRIVE),
    "mcap.zstd": lambda f: packed(mcap(f), ".zstd", ZSTD.compress),
    "mcap.zst of two frames": lambda f: packed(
        mcap(f), ".zst", lambda data: ZSTD.compress(data[:5000]) + ZSTD.compress(data[5000:])
    ),
    "mcap.gz": lambda f: packed(mcap(f), ".gz", gzip.compress),
    "mcap.bz2": lambda f: packed(mcap(f), ".bz2", bz2.compress),
    "mcap.xz": lambda f: packed(mcap(f), ".xz", lzma.compress),
}


@pytest.mark.parametrize("container", CONTAINERS)
def test_a_drive_is_read_to_the_last_byte_out_of_every_container(container: str, tmp_path: Path):
    (files,) = group_sessions([CONTAINERS[container](tmp_path)])
    session = open_session(files)
    assert session.mountings["front"].x_m == 0.2
    assert session.scan_counts == {"front": SCANS}
    assert not session.losses
    read = [(m.channel, m.type, m.log_ns, m.payload) for m in session.recording.messages()]
    assert read == [(m.channel, m.type, m.log_ns, m.payload) for m in DRIVE]


def test_replay_and_import_read_a_bag_by_the_command_line(tmp_path: Path):
    bag, out = CONTAINERS["bag of lz4 chunks"](tmp_path), tmp_path / "out"
    assert main(["replay", str(bag), "--out", str(out)]) == 0
    assert main(["import", "rosbag", str(packed(db3(tmp_path), ".zstd", ZSTD.compress)), f"{out}.mcap"]) == 0
    assert main(["replay", f"{out}.mcap", "--out", f"{out}2"]) == 0
    assert (out / "trajectory.tum").read_bytes() == (tmp_path / "out2" / "trajectory.tum").read_bytes()


def test_files_of_two_containers_are_not_one_recording(tmp_path: Path):
    with pytest.raises(InputError, match=r"files of MCAP and ROS 1 are not one recording; give them apart"):
        open_recording([CONTAINERS["bag"](tmp_path), mcap(tmp_path)])


def test_a_file_that_a_ros_2_folder_lacks_is_named(tmp_path: Path):
    folder = CONTAINERS["ROS 2 folder"](tmp_path)
    only_file(folder).unlink()
    with pytest.raises(InputError, match=r"drive.db3 of its metadata.yaml is not there"):
        open_session([folder])


def test_a_file_that_the_metadata_of_a_ros_2_folder_does_not_list_is_reported(tmp_path: Path):
    folder = write_ros2(tmp_path / "drive", DRIVE)
    file = only_file(folder)
    (folder / f"{file.name}.zst").write_bytes(ZSTD.compress(file.read_bytes()))
    assert open_session([folder]).recording.losses == []
    shutil.copy(file, folder / f"other{file.suffix}")
    session = open_session([folder])
    assert session.losses == [f"{folder}: metadata.yaml does not list other{file.suffix}; not read"]
    assert session.scan_counts == {"front": SCANS}


def test_a_packed_file_that_is_cut_off_is_read_as_far_as_it_goes(tmp_path: Path):
    whole = CONTAINERS["bag.gz"](tmp_path)
    cut = tmp_path / "cut.bag.gz"
    cut.write_bytes(whole.read_bytes()[:-5000])
    session = open_session([cut])
    assert SCANS // 2 < sum(1 for _ in session.recording.messages(["/front/scan"])) < SCANS
    assert [f"{cut} is cut off;" in session.losses[0], "was not closed" in session.losses[1]] == [True, True]


def test_packed_bytes_that_are_damaged_are_refused_in_words(tmp_path: Path):
    for k, suffix in enumerate((".gz", ".xz", ".bz2", ".zstd", ".lz4")):
        pack = {".gz": gzip.compress, ".xz": lzma.compress, ".bz2": bz2.compress, ".lz4": lz4.frame.compress}
        data = bytearray(pack.get(suffix, ZSTD.compress)(mcap(tmp_path).read_bytes()))
        data[20:400] = bytes(380)
        path = tmp_path / f"{k}.mcap{suffix}"
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"{k}.mcap{suffix} "):
            open_session([path])
        (tmp_path / "drive.mcap").unlink()


def test_no_place_to_unpack_is_a_storage_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = CONTAINERS["mcap.gz"](tmp_path)

    def full(*_arguments: object, **_more: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("service.recording.unpacking.mkdtemp", full)
    with pytest.raises(StorageError, match=r"cannot unpack .*drive.mcap.gz to .*: No space left on device"):
        open_session([path])
