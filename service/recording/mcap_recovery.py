"""Makes a valid MCAP of an unfinished or damaged one, keeping all messages that can be read.

The file is walked chunk by chunk with checksums. A bad chunk costs itself only: the walk goes on at the next
thing that looks like a chunk. Of a chunk that the end of the file cuts off, the complete messages are kept.
The result is read back with an independent reader (rosbags) before it takes the original's place.
"""

import fcntl
import logging
import mmap
import os
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from lz4.frame import LZ4FrameDecompressor
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from drivers.counted import counted
from service.errors import CorridorError, InputError, StorageError, words_of
from service.limits import MAX_CHUNK_BYTES, TooLargeError, Unpacking
from service.readable import open_file
from service.recording.mcap_chunks import ChunkRecord, chunk_records, complete_records
from service.recording.mcap_file import ACTIVE_SUFFIX, CHUNK_BYTES, LIBRARY, PROFILE, is_locked
from service.recording.mcap_reader import Recording
from service.recording.unpacking import NewDecompressor, unpacked, zstd_decompressor
from service.writable import sync

log = logging.getLogger(__name__)

MCAP_SUFFIX = ".mcap"
WORKING_SUFFIX = ".recovering"
DAMAGED_SUFFIX = ".damaged"  # the original, where something in its middle was lost
UNREADABLE_SUFFIX = ".unreadable"  # a leftover without a single message

_FRAME = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK_FIXED = struct.Struct("<QQQII")  # first and last log time, size, crc, length of the compression's name
# Names of compressions as they stand in a chunk, with their length -> what unpacks; None: it is not packed.
_DECOMPRESSORS: dict[bytes, NewDecompressor | None] = {
    b"\x04\x00\x00\x00zstd": zstd_decompressor,
    b"\x03\x00\x00\x00lz4": LZ4FrameDecompressor,
    b"\x00\x00\x00\x00": None,
}
_CHUNK_NAMES = [name for name, new in _DECOMPRESSORS.items() if new is not None]  # found among other bytes
_NAME_OFFSET = _FRAME.size + _CHUNK_FIXED.size - 4

Record = Schema | Channel | Message | Attachment | Metadata


@dataclass(slots=True)
class RecoveryReport:
    """What was found in `source` and written to `path`."""

    source: Path
    path: Path
    complete: bool = False  # nothing was wrong, nothing was changed
    messages: int = 0
    first_log_ns: int = 0
    last_log_ns: int = 0
    bad_chunks: int = 0  # in the middle; their content is lost
    skipped_bytes: int = 0  # of records that are cut off or damaged, even if messages were saved from them
    orphans: int = 0  # messages whose channel's definition was lost
    kept_original: Path | None = None

    def __str__(self) -> str:
        if self.complete:
            return f"{self.source} is complete ({counted(self.messages, 'message')}); nothing to do"
        text = (
            f"{self.path}: {counted(self.messages, 'message')} over "
            f"{(self.last_log_ns - self.first_log_ns) / 1e9:.1f} s"
        )
        if self.bad_chunks or self.orphans:
            text += (
                f"; lost {counted(self.bad_chunks, 'damaged chunk')} and "
                f"{counted(self.orphans, 'message')} without a channel"
            )
        if self.skipped_bytes:
            text += f"; cut off or damaged: {counted(self.skipped_bytes, 'byte')}"
        if self.kept_original is not None:
            text += f"; the original is kept as {self.kept_original}"
        return text


class InUseError(InputError):
    """A living process writes or recovers the file."""


def recover(source: Path) -> RecoveryReport:
    """Recover `x.mcap.active` to `x.mcap`, or a broken `x.mcap` in its place.

    Raises InputError where the file cannot be read, is no MCAP, in use, or without one readable message,
    or where its schemas are none, StorageError where the disk refuses, CorridorError where messages are
    missing when the result is read back. The source is
    untouched in all cases.
    """
    path = source.with_name(source.name.removesuffix(ACTIVE_SUFFIX))
    folder = path.with_name(path.name + WORKING_SUFFIX)
    report = RecoveryReport(source, path)
    try:
        stream = open_file(source)
    except OSError as error:
        raise InputError(f"cannot read {source}: {error.strerror}") from error
    try:
        with stream:
            _lock(source, stream)
            shutil.rmtree(folder, ignore_errors=True)  # of a recovery that was killed
            folder.mkdir()
            try:
                _recover(stream, folder / path.name, report)
            finally:
                shutil.rmtree(folder)
    except OSError as error:
        raise StorageError(f"cannot recover {source}: {words_of(error)}") from error
    return report


def _recover(stream: BinaryIO, working: Path, report: RecoveryReport) -> None:
    source = report.source
    _check_is_mcap(source, stream.read(len(MCAP0_MAGIC)))
    if report.path.suffix != MCAP_SUFFIX:  # no reader would take it
        raise InputError(
            f"{source}: a session is called NAME{MCAP_SUFFIX}, or NAME{MCAP_SUFFIX}{ACTIVE_SUFFIX} until it "
            "is finished; rename it, then recover it"
        )
    with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        walk = _Walk(data, source)
        definitions = _definitions(source, walk)
        if walk.complete and source == report.path and _reads_back(source, walk.messages):
            report.complete, report.messages = True, walk.messages
            return
        _copy(_Walk(data, source), definitions, working, report)
    _put_in_place(working, report)


def _lock(source: Path, stream: BinaryIO) -> None:
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InUseError(
            f"{source} is in use: a running service writes or recovers it; wait for it or stop it"
        ) from error


def _put_in_place(working: Path, report: RecoveryReport) -> None:
    source, path = report.source, report.path
    if report.messages == 0:
        raise InputError(f"{source} holds no message that can be read")
    if (count := _count_by_rosbags(working)) != report.messages:
        raise CorridorError(
            f"{counted(count, 'message')} read back of {report.messages}; {source} is untouched"
        )
    if source != path and path.exists() and not _reads_back(path, report.messages):
        raise CorridorError(f"{path} exists and differs from what is recovered from {source}; move one away")
    if report.bad_chunks or report.orphans or source == path:
        report.kept_original = path.with_name(path.name + DAMAGED_SUFFIX)
        if not report.kept_original.exists():
            source.rename(report.kept_original)
    working.replace(path)
    if source != path:
        source.unlink(missing_ok=True)
    sync(path.parent)


def _count_by_rosbags(path: Path) -> int:
    """Messages that a reader written by others finds. Raises InputError where it cannot read the file."""
    from rosbags.highlevel import AnyReader  # 0.1 s that few starts need

    try:
        with AnyReader([path]) as reader:
            return sum(1 for _ in reader.messages())
    except Exception as error:  # it may raise any exception
        about = str(error) or type(error).__name__
        raise InputError(f"what is left of {path.name} cannot be read by rosbags: {about}") from error


def _reads_back(path: Path, messages: int) -> bool:
    """Whether rosbags and a replay can read it."""
    try:
        read = sum(1 for _ in Recording([path]).messages())
        return read == messages == _count_by_rosbags(path)
    except CorridorError:
        return False


def _check_is_mcap(source: Path, magic: bytes) -> None:
    if magic != MCAP0_MAGIC:
        raise InputError(
            f"{source} is not an MCAP file: it begins with {magic.hex(' ') or 'nothing'}, "
            f"expected {MCAP0_MAGIC.hex(' ')}"
        )


class _Walk:
    """The records of a file in their order, whatever state it is in; counts what it had to pass over."""

    def __init__(self, data: mmap.mmap, source: Path) -> None:
        self._data = data
        self._source = source
        self._unpacking = Unpacking(source, len(data))
        self.bad_chunks = 0
        self.skipped_bytes = 0
        self.messages = 0
        self.saw_footer = False
        self.header: Header | None = None

    @property
    def complete(self) -> bool:
        """After the walk: whether nothing is missing, the index included."""
        ended = self._data[-len(MCAP0_MAGIC) :] == MCAP0_MAGIC
        return ended and self.saw_footer and not self.bad_chunks and not self.skipped_bytes

    def records(self) -> Iterator[Record]:
        offset, size = len(MCAP0_MAGIC), len(self._data)
        while offset < size and not self.saw_footer:
            opcode, end = self._frame(offset)
            if opcode is None or end > size:
                yield from self._salvage_cut_chunk(offset)
                resumed = self._next_chunk(offset + 1)
                self.skipped_bytes += resumed - offset
                offset = resumed
                continue
            body = self._data[offset + _FRAME.size : end]
            if opcode == Opcode.CHUNK:
                try:
                    yield from self._counted(_chunk_records(body, self._unpacking, self._source))
                except _BadChunkError as error:
                    self.bad_chunks += 1
                    end = self._next_chunk(offset + 1) if error.framing_lost else end
            else:
                yield from self._plain_record(opcode, body)
            offset = end

    def _frame(self, offset: int) -> tuple[Opcode | None, int]:
        """Opcode and end of the record at offset; None where there is no record."""
        if offset + _FRAME.size > len(self._data):
            return None, len(self._data)
        code, length = _FRAME.unpack_from(self._data, offset)
        try:
            return Opcode(code), offset + _FRAME.size + length
        except ValueError:
            return None, len(self._data)

    def _plain_record(self, opcode: Opcode, body: bytes) -> Iterator[Record]:
        stream = ReadDataStream(BytesIO(body))
        try:
            match opcode:
                case Opcode.HEADER:
                    self.header = Header.read(stream)
                case Opcode.FOOTER:
                    self.saw_footer = True
                case Opcode.SCHEMA:
                    yield Schema.read(stream)
                case Opcode.CHANNEL:
                    yield Channel.read(stream)
                case Opcode.MESSAGE:
                    yield from self._counted([Message.read(stream, len(body))])
                case Opcode.ATTACHMENT:
                    yield Attachment.read(stream)
                case Opcode.METADATA:
                    yield Metadata.read(stream)
                case _:
                    pass  # indexes; the copy gets its own
        except Exception:  # a record with bad bytes in it may raise any exception
            self.skipped_bytes += _FRAME.size + len(body)

    def _counted(self, records: Sequence[Record]) -> Sequence[Record]:
        self.messages += sum(isinstance(record, Message) for record in records)
        return records

    def _salvage_cut_chunk(self, offset: int) -> Iterator[Record]:
        """The complete records at the beginning of a chunk whose end is missing."""
        begin = self._data[offset : offset + _NAME_OFFSET + 16]
        name = next((name for name in _DECOMPRESSORS if begin[_NAME_OFFSET:].startswith(name)), None)
        if begin[0] != Opcode.CHUNK or name is None:
            return
        start = offset + _NAME_OFFSET + len(name) + 8
        packed = self._data[start : start + MAX_CHUNK_BYTES]
        new = _DECOMPRESSORS[name]
        try:
            what = f"{self._source}: a chunk"
            content = packed if new is None else unpacked(packed, new, MAX_CHUNK_BYTES, what)
            self._unpacking.take(len(content))
            records, _ = complete_records(content, self._source)
        except TooLargeError:
            raise
        except Exception:  # bad bytes may raise any exception
            return
        _, _, size, crc, _ = _CHUNK_FIXED.unpack_from(self._data, offset + _FRAME.size)
        if len(content) == size and crc and zlib.crc32(content) != crc:
            return
        yield from self._counted(records)

    def _next_chunk(self, offset: int) -> int:
        """Offset at which the next chunk seems to begin, or the end of the file."""
        return min(self._find_chunk(name, offset) for name in _CHUNK_NAMES)

    def _find_chunk(self, name: bytes, offset: int) -> int:
        at = offset + _NAME_OFFSET - 1
        while (at := self._data.find(name, at + 1)) >= 0:
            if self._data[at - _NAME_OFFSET] == Opcode.CHUNK:
                return at - _NAME_OFFSET
        return len(self._data)


class _BadChunkError(Exception):
    def __init__(self, framing_lost: bool) -> None:
        super().__init__()
        self.framing_lost = framing_lost  # the length of the record itself cannot be trusted


def _chunk_records(body: bytes, unpacking: Unpacking, source: Path) -> list[ChunkRecord]:
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
    except Exception as error:  # bad bytes may raise any exception
        raise _BadChunkError(framing_lost=True) from error
    length = _CHUNK_FIXED.size + len(chunk.compression) + 8 + len(chunk.data)
    try:
        return chunk_records(chunk, unpacking, source)
    except TooLargeError:
        raise
    except Exception as error:  # as above: zstd, lz4, struct, unicode and checksum errors
        raise _BadChunkError(framing_lost=length != len(body)) from error


@dataclass(slots=True)
class _Definitions:
    """Schemas and channels from anywhere in the file: the index at its end repeats those of a lost chunk."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)


def _definitions(source: Path, walk: _Walk) -> _Definitions:
    found = _Definitions()
    for record in walk.records():
        if isinstance(record, Schema):
            found.schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            found.channels.setdefault(record.id, record)
    if walk.header is not None and walk.header.profile != PROFILE:
        raise InputError(
            f'{source} is an MCAP file of profile "{walk.header.profile}"; only those of profile "{PROFILE}" '
            "are recovered"
        )
    return found


def _copy(walk: _Walk, definitions: _Definitions, path: Path, report: RecoveryReport) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile=PROFILE, library=LIBRARY)
        schema_ids = {
            schema.id: writer.register_schema(schema.name, schema.encoding, schema.data)
            for schema in definitions.schemas.values()
        }
        channel_ids = {
            c.id: writer.register_channel(c.topic, c.message_encoding, schema_ids[c.schema_id], c.metadata)
            for c in definitions.channels.values()
            if c.schema_id in schema_ids
        }
        for record in walk.records():
            match record:
                case Message():
                    if record.channel_id not in channel_ids:
                        report.orphans += 1
                        continue
                    writer.add_message(
                        channel_ids[record.channel_id],
                        record.log_time,
                        record.data,
                        record.publish_time,
                        record.sequence,
                    )
                    if report.messages == 0:
                        report.first_log_ns = report.last_log_ns = record.log_time
                    report.messages += 1
                    report.first_log_ns = min(report.first_log_ns, record.log_time)
                    report.last_log_ns = max(report.last_log_ns, record.log_time)
                case Metadata():
                    writer.add_metadata(record.name, record.metadata)
                case Attachment():
                    writer.add_attachment(
                        record.create_time, record.log_time, record.name, record.media_type, record.data
                    )
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
        stream.flush()
        os.fsync(stream.fileno())
    report.bad_chunks, report.skipped_bytes = walk.bad_chunks, walk.skipped_bytes


class Leftovers:
    """Recovers unfinished files of an earlier run in a process of its own: decompressing and copying them in
    this one would make the readers of the sensors wait for the interpreter.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        command = [sys.executable, "-m", "service.recording.mcap_recovery", *map(str, paths)]
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def stop(self) -> None:
        """Stop; the next start begins again, and nothing is lost."""
        self._process.kill()
        self._process.wait()


def recover_leftovers(paths: Sequence[Path]) -> None:
    """Recover each; an empty one is removed, one that cannot be read is renamed so that it is not tried
    again, what fails is logged.
    """
    for path in paths:
        try:
            if is_locked(path):
                log.warning(
                    "%s is being written: another service has this recording.directory, too; give each its "
                    "own, for `corridor fleet pull` fetches all that is there from either",
                    path,
                )
                continue
            if path.stat().st_size == 0:  # killed before the first batch was written
                path.unlink()
                log.info("removed %s, which was empty", path)
                continue
            log.info("recovered %s", recover(path))
        except InUseError as error:  # since the look above
            log.info("%s", error)
        except InputError as error:
            aside = path.with_name(path.name.removesuffix(ACTIVE_SUFFIX) + UNREADABLE_SUFFIX)
            path.rename(aside)
            log.warning("%s; kept as %s", error, aside.name)
        except (CorridorError, OSError) as error:
            log.error("%s; it will be tried again at the next start", error)


if __name__ == "__main__":
    os.nice(10)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    recover_leftovers([Path(argument) for argument in sys.argv[1:]])
