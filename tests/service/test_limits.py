"""Files whose sizes are lies, or which become much larger: refused before they are unpacked."""

import bz2
import gzip
import json
import lzma
import os
import resource
import sqlite3
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, DataEnd, Footer, Header, McapRecord, Schema
from mcap.writer import MCAP0_MAGIC

from service import limits
from service.errors import InputError, UsageError
from service.limits import SETTING, TooLargeError, Unpacking, check
from service.mapstore import arrays
from service.mapstore.arrays import read_arrays
from service.mapstore.files import check_versions, load_map, save_map
from service.mapstore.manifest import digest_of, read_manifest
from service.offline.importing.carmen import import_carmen
from service.readable import open_file, refuse_unreadable
from service.recording import mcap_chunks, mcap_reader
from service.recording.bag_reader import refuse_other_than_tables
from service.recording.mcap_reader import Recording
from service.recording.mcap_recovery import recover
from service.recording.unpacking import Unpacked
from tests.service.mapstore.tile_makers import tile
from tests.service.recording.sessions import drive, write_file

MB = 1 << 20
MOST_MB = 300  # more than such a refusal may take of memory: zstd unpacks 4 kB at a time, to 130 MB


def record(value: McapRecord) -> bytes:
    builder = RecordBuilder()
    value.write(builder)
    return builder.end()


def chunk(content: bytes, compression: str = "zstd", size: int | None = None) -> bytes:
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}[compression](content)
    size = len(content) if size is None else size
    return record(Chunk(compression, packed, 10, 0, 0, size))


def write_mcap(path: Path, *chunks: bytes) -> Path:
    head = (
        Header("ros2", "a client"),
        Schema(1, b"", "ros2msg", "std_msgs/msg/String"),
        Channel(1, "/a", "cdr", {}, 1),
    )
    end = DataEnd(0), Footer(0, 0, 0)
    path.write_bytes(MCAP0_MAGIC + b"".join([*map(record, head), *chunks, *map(record, end)]) + MCAP0_MAGIC)
    return path


@pytest.fixture
def few_bytes() -> Iterator[None]:
    """That the memory of this process grows no further than by a refusal."""
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < MOST_MB * 1024


@pytest.mark.usefixtures("few_bytes")
@pytest.mark.parametrize("read", [lambda path: Recording([path]), recover], ids=["replay", "recover"])
@pytest.mark.parametrize(
    ("chunk", "diagnostic"),
    [
        (chunk(bytes(64 * MB)), "x.mcap: unpacked: 67108864 bytes, at most .*CORRIDOR_FILE_LIMITS=4"),
        (chunk(b"", size=1 << 60), "a chunk, unpacked: 1152921504606846976 bytes, at most 268435456"),
    ],
)
def test_a_recording_that_unpacks_beyond_the_limits_is_refused_first(tmp_path, read, chunk, diagnostic):
    with pytest.raises(InputError, match=diagnostic):
        read(write_mcap(tmp_path / "x.mcap", chunk))


@pytest.mark.usefixtures("few_bytes")
@pytest.mark.parametrize(
    ("chunk", "diagnostic"),
    [
        (chunk(bytes(400 * MB), size=100), "a chunk of 100 bytes claims to be one of 419430400 inside"),
        (chunk(bytes(400 * MB), "lz4", size=100), "unpacks to 101 bytes, its header says 100"),
        (chunk(bytes(9), size=9), "no whole record at byte 0 of 9"),
        (record(Chunk("brotli", b"", 0, 0, 0, 0)), "compressed by 'brotli'"),
    ],
)
def test_a_chunk_that_is_not_what_its_header_says_is_damaged(tmp_path, chunk, diagnostic):
    with pytest.raises(InputError, match=diagnostic):
        Recording([write_mcap(tmp_path / "x.mcap", chunk)])


def test_a_chunk_holds_no_more_records_than_the_limit(monkeypatch):
    monkeypatch.setattr(mcap_chunks, "MAX_CHUNK_RECORDS", 99)
    of_another_version = b"\x90" + bytes(8)
    assert mcap_chunks.complete_records(of_another_version * 99, "x") == ([], 99 * 9)
    with pytest.raises(TooLargeError, match="x: a chunk: 100 records, at most 99"):
        mcap_chunks.complete_records(of_another_version * 100, "x")


def test_messages_that_wait_to_be_put_in_order_are_counted(tmp_path, monkeypatch):
    path = tmp_path / "x.mcap"
    write_file(path, drive(20))
    monkeypatch.setattr(mcap_reader, "MAX_WAITING_BYTES", 10_000)
    with pytest.raises(TooLargeError, match=r"x.mcap: messages to be put in order"):
        list(Recording([path]).messages())


@pytest.mark.usefixtures("few_bytes")
@pytest.mark.parametrize(
    "pack",
    [gzip.compress, bz2.compress, lzma.compress, zstandard.compress, lz4.frame.compress],
    ids=["gz", "bz2", "xz", "zstd", "lz4"],
)
def test_a_packed_recording_becomes_no_larger_than_the_limits(tmp_path, pack, monkeypatch):
    monkeypatch.setattr(limits, "MAX_RATIO", 100)
    monkeypatch.setattr(limits, "FREE_BYTES", MB)
    path = tmp_path / "x.mcap.packed"
    path.write_bytes(pack(bytes(30 * MB)))
    with pytest.raises(TooLargeError, match=r"x.mcap.packed: unpacked: \d+ bytes, at most"):
        Unpacked(path)


def test_a_log_has_no_endless_line_and_is_no_bomb(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "FREE_BYTES", 1000)
    monkeypatch.setattr(limits, "MAX_RATIO", 100)
    (tmp_path / "a.log").write_bytes(b"FLASER " + b"1.0 " * MB)
    with pytest.raises(TooLargeError, match=r"a.log: a line: 1048577 bytes"):
        import_carmen(tmp_path / "a.log", tmp_path / "a.mcap")
    (tmp_path / "b.log").write_bytes(gzip.compress(b"#\n" * MB))
    with pytest.raises(TooLargeError, match=r"b.log: unpacked"):
        import_carmen(tmp_path / "b.log", tmp_path / "b.mcap")


@pytest.mark.usefixtures("few_bytes")
def test_arrays_are_no_larger_than_the_limits(tmp_path, monkeypatch):
    path = tmp_path / "x.npz"
    with zipfile.ZipFile(path, "w") as file, file.open("a.npy", "w") as member:
        about = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)}
        np.lib.format.write_array_header_1_0(member, about)
    with pytest.raises(InputError, match=r"x.npz: "):
        read_arrays(path)
    monkeypatch.setattr(arrays, "MAX_ARRAYS_BYTES", 10_000)
    np.savez_compressed(path, a=np.zeros(1000), b=np.zeros(1000))
    with pytest.raises(TooLargeError, match=r"x.npz: unpacked: 16\d+ bytes, at most 10000"):
        read_arrays(path)


def test_elements_without_bytes_are_counted_too(tmp_path):
    np.savez(tmp_path / "x.npz", names=np.ndarray(10**6, "S0"))
    with pytest.raises(InputError, match="claims 1000000 elements in"):
        read_arrays(tmp_path / "x.npz")


def test_pipes_and_devices_are_refused_and_never_waited_for(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, kind in ((pipe, "pipe"), (Path("/dev/zero"), "device")):
        for read in (open_file, refuse_unreadable, Unpacked, recover):
            with pytest.raises(InputError, match=f"{path}: a {kind}; expected a regular file"):
                read(path)


@pytest.mark.parametrize("name", ["manifest.json", "tiles.npz"])
def test_a_pipe_in_a_map_is_a_damaged_version(tmp_path, name):
    save_map(tmp_path, [tile(0, 0, 1)], 1)
    save_map(tmp_path, [tile(0, 0, 2)], 2)
    path = tmp_path / "v000002" / name
    path.unlink()
    os.mkfifo(path)
    assert check_versions(tmp_path)[0] == [1]
    assert load_map(tmp_path).number == 1


@pytest.mark.parametrize(
    ("change", "diagnostic"),
    [
        (lambda m: m["files"].update({"../../secret.npz": {"bytes": 0, "sha256": ""}}), "pattern"),
        (lambda m: m["files"]["tiles.npz"].update(bytes=1 << 50), "the map: 11258999.* CORRIDOR_FILE_LIMITS"),
        (lambda m: m.update(files=[]), "files"),
        (lambda m: m.update(edit={"who": "I"}), "edit.what"),
        (lambda m: m.update(saved_ns=1 << 70), "saved_ns"),
        (lambda m: m.pop("about"), "about"),
    ],
)
def test_a_manifest_that_fits_its_checksum_is_checked_all_the_same(tmp_path, change, diagnostic):
    save_map(tmp_path, [tile(0, 0, 1)], 1)
    path = tmp_path / "v000001" / "manifest.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    del manifest["sha256"]
    path.write_text(json.dumps(manifest | {"sha256": digest_of(manifest)}))
    with pytest.raises(InputError, match=diagnostic):
        read_manifest(path.parent)


def test_a_bag_whose_rows_are_computed_is_refused(tmp_path):
    with closing(sqlite3.connect(tmp_path / "a.db3")) as database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL)")
        database.execute("CREATE INDEX by_name ON topics (name ASC)")
        refuse_other_than_tables(tmp_path / "a.db3")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
            "SELECT i FROM n"
        )
    with pytest.raises(InputError, match="'messages' is computed as it is read"):
        refuse_other_than_tables(tmp_path / "a.db3")


def test_the_setting_multiplies_every_limit(monkeypatch):
    with pytest.raises(TooLargeError, match="x: 250 bytes, at most 100 are read; CORRIDOR_FILE_LIMITS=3 in"):
        check(250, 100, "x")
    one = Unpacking("x", 0).left
    monkeypatch.setenv(SETTING, "3")
    check(250, 100, "x")
    assert Unpacking("x", 0).left == 3 * one
    for odd in ("many", "0", "-1", "inf", "nan"):
        monkeypatch.setenv(SETTING, odd)
        with pytest.raises(UsageError, match=f"{SETTING}={odd}: expected a factor above 0"):
            check(250, 100, "x")
