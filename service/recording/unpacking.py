"""Recordings as files that readers can seek in: unpacked where they are compressed as one file."""

import bz2
import lzma
import shutil
import sqlite3
import weakref
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import gettempdir, mkdtemp
from typing import Any, BinaryIO

import lz4.frame
import zstandard

from service.archive import copy_here, is_remote, open_binary
from service.errors import InputError, StorageError, words_of
from service.limits import MAX_MESSAGE_BYTES, MAX_XZ_BYTES, Unpacking, check, factor
from service.readable import refuse_unreadable

MCAP, ROS1, SQLITE = "MCAP", "ROS 1", "SQLite"
_KINDS = {b"\x89MCAP0\r\n": MCAP, b"#ROSBAG V": ROS1, b"SQLite format 3\0": SQLITE}
_SUFFIXES = {MCAP: ".mcap", ROS1: ".bag", SQLITE: ".db3"}  # rosbags goes by them
_MAX_MAGIC_BYTES = 16
_BLOCK_BYTES = 1 << 12
_PART_BYTES = 1 << 20
_SPECIAL_IN_URI = frozenset("?#%")  # rosbags opens a db3 by a URI in which it quotes nothing

NewDecompressor = Callable[[], Any]  # with decompress, eof and unused_data, as those of the standard library
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


def zstd_decompressor() -> Any:
    return zstandard.ZstdDecompressor().decompressobj()


_DECOMPRESSORS: dict[bytes, NewDecompressor] = {
    _ZSTD_MAGIC: zstd_decompressor,
    b"\x1f\x8b": lambda: zlib.decompressobj(zlib.MAX_WBITS | 16),
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ\0": lambda: lzma.LZMADecompressor(memlimit=round(MAX_XZ_BYTES * factor())),
    b"\x04\x22\x4d\x18": lz4.frame.LZ4FrameDecompressor,
}


class UnpackError(ValueError):
    """Bytes that no decompressor takes."""


class Unpacked:
    """A file as it is to be read.

    given      as it was named
    path       itself, or a copy in a temporary folder, which goes with this object
    is_packed  whether it is compressed as one file
    kind       MCAP, ROS1, SQLITE; "" for none of them
    beginning  its first bytes, to be shown
    size       of the file as it was named, bytes
    losses     what could not be unpacked, to be shown

    Raises InputError where the file cannot be read or unpacked, StorageError where there is no place for it.
    """

    def __init__(self, given: Path) -> None:
        self.given = self.path = given
        refuse_unreadable(given)
        self.size = given.stat().st_size or 0  # a web server may not state it
        self.losses: list[str] = []
        magic = _magic(given)
        new = decompressor_of(magic)
        self.is_packed = new is not None
        try:
            if new is not None:
                self._unpack(new)
            magic = _magic(self.path)
            self.kind = next((kind for mark, kind in _KINDS.items() if magic.startswith(mark)), "")
            cut = "it is cut off, and unpacked " if self.losses else ""
            self.beginning = f"{cut}it begins with {magic[:8].hex(' ') or 'nothing'}"
            if is_remote(self.path) and self.kind in (ROS1, SQLITE):  # rosbags reads local files alone
                self.path = self._new_path()
                copy_here(given, self.path)
            if self.kind == SQLITE:
                self._prepare_sqlite()
            elif self.path != given and self.kind:
                self.path = self.path.rename(self.path.with_suffix(_SUFFIXES[self.kind]))
        except OSError as error:
            raise StorageError(
                f"cannot unpack {given} to {gettempdir()}: {words_of(error)}; TMPDIR names another folder"
            ) from error

    def _new_path(self) -> Path:
        folder = mkdtemp(prefix="corridor-")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        return Path(folder) / f"recording{_SUFFIXES[SQLITE]}"

    def _unpack(self, new: NewDecompressor) -> None:
        self.path = self._new_path()
        with open_binary(self.given) as source, self.path.open("xb") as target:
            is_cut = self._decompress(source, new, target)
            if is_cut:
                self.losses = [f"{self.given} is cut off; {target.tell()} bytes of it could be unpacked"]

    def _decompress(self, source: BinaryIO, new: NewDecompressor, target: BinaryIO) -> bool:
        """Decompress a file of one part or several; True where its end is missing."""
        stream = None
        unpacking = Unpacking(self.given, self.size)
        while block := source.read(_BLOCK_BYTES):
            while block:
                stream = new() if stream is None else stream
                try:
                    for content in _contents(stream, block):
                        unpacking.take(len(content))
                        target.write(content)
                except UnpackError as error:
                    raise InputError(f"{self.given} cannot be unpacked: {error}") from error
                block = b""
                if stream.eof:
                    block, stream = stream.unused_data, None
        return stream is not None

    def _prepare_sqlite(self) -> None:
        """rosbags reads the file alone, without the log in which a writer that died left its last rows."""
        log = self.given.with_name(f"{self.given.name}-wal")
        has_log = not self.is_packed and not is_remote(log) and log.is_file() and log.stat().st_size > 0
        if has_log:
            path = self._new_path()
            shutil.copyfile(self.given, path)
            shutil.copyfile(log, path.with_name(f"{path.name}-wal"))
            try:
                database = sqlite3.connect(path)
                database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
                database.close()
            except sqlite3.Error as error:
                raise InputError(f"{log} cannot be read: {error}") from error
            self.path = path
        elif self.path.suffix != _SUFFIXES[SQLITE] or _SPECIAL_IN_URI & set(str(self.path)):
            link = self._new_path()
            link.symlink_to(self.path.resolve())
            self.path = link


def decompressor_of(packed: bytes) -> NewDecompressor | None:
    """Decompressor by the first bytes; None for an uncompressed file."""
    return next((new for mark, new in _DECOMPRESSORS.items() if packed.startswith(mark)), None)


def plain(payload: bytes) -> bytes:
    """A message as it was before rosbag2 compressed it alone; CDR itself begins with a 0."""
    if payload[:4] != _ZSTD_MAGIC:
        return payload
    try:
        return unpacked(payload, zstd_decompressor, MAX_MESSAGE_BYTES, "a message")
    except UnpackError:
        return b""  # which no decoder takes


def unpacked(packed: bytes, new: NewDecompressor, limit: int, what: str) -> bytes:
    """Readable content of one stream, whose end may be missing. Raises TooLargeError beyond the limit,
    UnpackError for bad bytes.
    """
    stream, content = new(), bytearray()
    for at in range(0, len(packed), _BLOCK_BYTES):
        for part in _contents(stream, packed[at : at + _BLOCK_BYTES]):
            content += part
            check(len(content), limit, f"{what}, unpacked")
        if stream.eof:
            break
    return bytes(content)


def _contents(stream: Any, block: bytes) -> Iterator[bytes]:
    """Decompressed parts of a block. Raises UnpackError."""
    try:
        if not hasattr(stream, "needs_input"):  # zlib and zstd, which cannot be stopped, reach 4 and 130 MB
            yield stream.decompress(block)
            return
        yield stream.decompress(block, _PART_BYTES)
        while not (stream.eof or stream.needs_input):
            yield stream.decompress(b"", _PART_BYTES)
    except Exception as error:  # bad bytes raise another exception in each library
        raise UnpackError(str(error)) from error


def _magic(path: Path) -> bytes:
    try:
        with open_binary(path) as stream:
            return stream.read(_MAX_MAGIC_BYTES)
    except OSError as error:
        raise InputError(f"cannot read {path}: {words_of(error)}") from error
