"""Reads MCAP recordings of ROS 2 as one stream of messages in the order of their log times."""

import heapq
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from shlex import quote
from typing import BinaryIO, Protocol

from mcap.data_stream import ReadDataStream
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, Schema, Statistics
from mcap.records import Message as Record
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from service.archive import open_binary
from service.encoding import Message
from service.encoding.ros_messages import FIELDDEFS
from service.errors import InputError, words_of
from service.limits import MAX_WAITING_BYTES, Unpacking, check
from service.recording.definitions import cdr_of_ros1, is_known, ros2_type
from service.recording.mcap_chunks import all_records, chunk_records
from service.recording.unpacking import MCAP, Unpacked, plain

ROS1_ENCODING = "ros1"  # of `mcap convert` from a bag of ROS 1
DEFINITIONS = ("ros1msg", "ros2msg")  # encodings of schemas
ANOTHER = "another message of its name"  # in place of the encoding: the recording defines other fields
RECORD_HEAD_BYTES = 9  # opcode, and length of what follows
MESSAGE_BYTES = 300  # that a message takes in memory besides its payload


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a recording. type is the ROS 2 name, "sensor_msgs/msg/LaserScan"."""

    name: str
    type: str
    encoding: str  # "cdr" for ROS 2, ANOTHER
    count: int

    def __str__(self) -> str:
        return f"{self.name} ({self.type}, {self.count})"


@dataclass(frozen=True, slots=True)
class _File:
    file: Unpacked
    library: str
    topics: tuple[Topic, ...]
    first_log_ns: int
    last_log_ns: int
    metadata: dict[str, dict[str, str]]
    summary: Summary  # with every schema and channel, also where that of the file lacks some


class Readable(Protocol):
    """A recording of any container as ROS 2 messages, see Recording.

    paths     as they were named, oldest first
    library   who wrote it
    losses    what could not be read of its files, to be shown
    """

    paths: list[Path]
    library: str
    first_log_ns: int
    last_log_ns: int
    metadata: dict[str, dict[str, str]]
    topics: list[Topic]
    losses: list[str]

    def messages(
        self, topics: Collection[str] | None = None, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[Message]: ...


class Recording:
    """One or more finished MCAP files, oldest first, as one recording. A folder stands for its files.

    Raises InputError for a file that is missing, not MCAP, unfinished, or broken.
    """

    def __init__(self, paths: Sequence[Path | Unpacked]) -> None:
        files = sorted((_open(file) for file in _expand(paths)), key=lambda file: file.first_log_ns)
        self._files = files
        self.paths = [file.file.given for file in files]
        self.losses = [loss for file in files for loss in file.file.losses]
        self.library = files[0].library  # who wrote it
        self.first_log_ns = files[0].first_log_ns
        self.last_log_ns = max(file.last_log_ns for file in files)
        self.metadata: dict[str, dict[str, str]] = {}  # the last of a name wins
        counts: Counter[tuple[str, str, str]] = Counter()
        for file in files:
            self.metadata.update(file.metadata)
            for topic in file.topics:
                counts[topic.name, topic.type, topic.encoding] += topic.count
        self.topics = [Topic(*key, count) for key, count in sorted(counts.items())]

    def messages(
        self, topics: Collection[str] | None = None, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[Message]:
        """Messages by rising log time, those of equal log time as they stand in the file.

        from_ns, to_ns    log times of the first and the last that are wanted, both included; None: all.
                          Of a file with an index only the parts that have them are read.

        Raises InputError at a damaged place.
        """
        streams = [
            _messages(file, topics, from_ns, to_ns)
            for file in self._files
            if (from_ns is None or from_ns <= file.last_log_ns)
            and (to_ns is None or to_ns >= file.first_log_ns)
        ]
        if all(a.last_log_ns < b.first_log_ns for a, b in pairwise(self._files)):
            for stream in streams:
                yield from stream
        else:
            yield from heapq.merge(*streams, key=lambda message: message.log_ns)


def _expand(paths: Sequence[Path | Unpacked]) -> list[Unpacked]:
    files: list[Unpacked] = []
    for path in paths:
        if isinstance(path, Unpacked):
            files.append(path)
        else:
            files += map(Unpacked, sorted(path.glob("*.mcap")) if path.is_dir() else [path])
    if not files:
        raise InputError(f"no MCAP files in {', '.join(map(str, paths))}")
    return files


def _open(file: Unpacked) -> _File:
    try:
        with open_binary(file.path) as stream:
            _check_ends(file, stream)
            return _read_index(file, stream)
    except OSError as error:
        raise InputError(f"cannot read {file.given}: {words_of(error)}") from error
    except InputError:
        raise
    except Exception as error:  # a broken index may raise any exception inside the library
        raise _damaged(file, error) from error


def _damaged(file: Unpacked, error: Exception) -> InputError:
    why = str(error) or type(error).__name__  # some errors of the library have no text
    return InputError(f"{file.given} is damaged: {why}; {_unpack_first(file)}try {_recover(file)}")


def _unpack_first(file: Unpacked) -> str:
    return "unpack it, and " if file.is_packed else ""


def _recover(file: Unpacked) -> str:
    given = file.given.with_suffix("") if file.is_packed else file.given
    return f"`corridor recover {quote(str(given))}`"


def _check_ends(file: Unpacked, stream: BinaryIO) -> None:
    size = len(MCAP0_MAGIC)
    if file.kind != MCAP:
        raise InputError(f"{file.given} is not an MCAP file: {file.beginning}")
    stream.seek(-size, 2)
    if stream.read(size) != MCAP0_MAGIC:
        raise InputError(
            f"{file.given} was never finished; {_unpack_first(file)}make it whole with {_recover(file)}"
        )
    stream.seek(0)


def _read_index(file: Unpacked, stream: BinaryIO) -> _File:
    reader = SeekingReader(stream)
    header = reader.get_header()
    summary = reader.get_summary()
    if summary is not None and _is_whole(summary):
        metadata = list(reader.iter_metadata())
    else:
        summary, metadata = _scan(file, stream)
    statistics = summary.statistics
    assert statistics is not None
    topics = tuple(
        _topic(channel, summary.schemas, statistics.channel_message_counts.get(channel.id, 0))
        for channel in summary.channels.values()
    )
    return _File(
        file,
        header.library,
        topics,
        statistics.message_start_time,
        statistics.message_end_time,
        {record.name: dict(record.metadata) for record in metadata},
        summary,
    )


def _is_whole(summary: Summary) -> bool:
    """MCAP leaves it to the writer which records the summary repeats."""
    statistics, channels = summary.statistics, summary.channels
    return (
        statistics is not None
        and bool(channels)
        and statistics.channel_count == len(channels)
        and statistics.channel_message_counts.keys() <= channels.keys()
        and {channel.schema_id for channel in channels.values()} <= summary.schemas.keys() | {0}
        and statistics.chunk_count == len(summary.chunk_indexes)
        and statistics.metadata_count == len(summary.metadata_indexes)
    )


def _scan(file: Unpacked, stream: BinaryIO) -> tuple[Summary, list[Metadata]]:
    """Content of a summary, from the data itself. There are no chunk indexes in it: messages are then read
    from the file's beginning to its end.
    """
    summary, metadata = Summary(), list[Metadata]()
    first_ns: int | None = None
    last_ns = 0
    counts: Counter[int] = Counter()
    stream.seek(0)
    for record in all_records(stream, Unpacking(file.given, file.size), file.given):
        match record:
            case Schema():
                summary.schemas[record.id] = record
            case Channel():
                summary.channels[record.id] = record
            case Record():
                counts[record.channel_id] += 1
                first_ns = record.log_time if first_ns is None else min(first_ns, record.log_time)
                last_ns = max(last_ns, record.log_time)
            case Metadata():
                metadata.append(record)
    summary.statistics = Statistics(
        attachment_count=0,
        channel_count=len(summary.channels),
        channel_message_counts=dict(counts),
        chunk_count=0,
        message_count=counts.total(),
        message_end_time=last_ns,
        message_start_time=first_ns or 0,
        metadata_count=len(metadata),
        schema_count=len(summary.schemas),
    )
    return summary, metadata


@dataclass(frozen=True, slots=True, order=True)
class _Place:
    """Position of a chunk, or a message in it, in the order of reading."""

    log_ns: int
    chunk_at: int
    index: int = -1  # in its chunk; a chunk comes before its messages


class _Walk:
    """The messages of one file by rising log time. Of a file with an index, only chunks that are wanted are
    unpacked, and those that overlap in time are read ahead.
    """

    def __init__(
        self,
        file: _File,
        stream: BinaryIO,
        topics: Collection[str] | None,
        from_ns: int | None,
        to_ns: int | None,
    ) -> None:
        self._file = file
        self._stream = stream
        self._from_ns, self._to_ns = from_ns, to_ns
        schemas = file.summary.schemas
        self._ids = {
            k
            for k, channel in file.summary.channels.items()
            if (topics is None or channel.topic in topics) and _topic(channel, schemas, 0).encoding != ANOTHER
        }
        self._unpacking = Unpacking(file.file.given, file.file.size)
        self._waiting: list[tuple[_Place, ChunkIndex | Record]] = []
        self._waiting_bytes = 0

    def messages(self) -> Iterator[Record]:
        what = self._file.file.given
        chunks = self._file.summary.chunk_indexes
        for chunk in filter(self._is_wanted, chunks):
            self._push(_Place(chunk.message_start_time, chunk.chunk_start_offset), chunk)
        if not chunks:
            self._stream.seek(0)
            self._take(0, all_records(self._stream, self._unpacking, what))
        while self._waiting:
            place, item = heapq.heappop(self._waiting)
            if isinstance(item, Record):
                self._waiting_bytes -= len(item.data)
                yield item
            else:
                self._stream.seek(place.chunk_at + RECORD_HEAD_BYTES)
                chunk = Chunk.read(ReadDataStream(self._stream))
                self._take(place.chunk_at, chunk_records(chunk, self._unpacking, what))

    def _is_wanted(self, chunk: ChunkIndex) -> bool:
        indexed = chunk.message_index_offsets.keys()
        return (
            (self._from_ns is None or chunk.message_end_time >= self._from_ns)
            and (self._to_ns is None or chunk.message_start_time <= self._to_ns)
            and (not indexed or not self._ids.isdisjoint(indexed))
        )

    def _take(self, chunk_at: int, records: Iterable[object]) -> None:
        for index, record in enumerate(records):
            if (
                isinstance(record, Record)
                and record.channel_id in self._ids
                and (self._from_ns is None or record.log_time >= self._from_ns)
                and (self._to_ns is None or record.log_time <= self._to_ns)
            ):
                self._push(_Place(record.log_time, chunk_at, index), record)

    def _push(self, place: _Place, item: ChunkIndex | Record) -> None:
        heapq.heappush(self._waiting, (place, item))
        if isinstance(item, Record):
            self._waiting_bytes += len(item.data) + MESSAGE_BYTES
        check(
            self._waiting_bytes,
            MAX_WAITING_BYTES,
            f"{self._file.file.given}: messages to be put in order (`mcap sort` writes a file that is)",
        )


def _topic(channel: Channel, schemas: dict[int, Schema], count: int) -> Topic:
    schema = schemas.get(channel.schema_id)
    type_name = _type_name(schema.name if schema is not None else "")
    encoding = channel.message_encoding
    if encoding == ROS1_ENCODING and type_name in FIELDDEFS:
        encoding = "cdr"
    if not is_known(type_name, _definition(schema)):
        encoding = ANOTHER
    return Topic(channel.topic, type_name, encoding, count)


def _definition(schema: Schema | None) -> str:
    """Its .msg of ROS 1 or ROS 2; "" without one."""
    if schema is None or schema.encoding not in DEFINITIONS:
        return ""
    return schema.data.decode(errors="replace")


def _type_name(schema: str) -> str:
    """ "sensor_msgs/LaserScan", as some write it, is "sensor_msgs/msg/LaserScan" in ROS 2."""
    package, _, name = schema.partition("/")
    return ros2_type(schema if not name or "/" in name else f"{package}/msg/{name}")


def _messages(
    file: _File, topics: Collection[str] | None, from_ns: int | None, to_ns: int | None
) -> Iterator[Message]:
    try:
        with open_binary(file.file.path) as stream:
            for record in _Walk(file, stream, topics, from_ns, to_ns).messages():
                channel = file.summary.channels[record.channel_id]
                schema = file.summary.schemas[channel.schema_id] if channel.schema_id else None
                type_name = _type_name(schema.name if schema is not None else "")
                payload = plain(record.data)
                if channel.message_encoding == ROS1_ENCODING and type_name in FIELDDEFS:
                    payload = cdr_of_ros1(type_name, payload)
                yield Message(
                    channel=channel.topic.removeprefix("/"),
                    type=type_name,
                    stamp_ns=record.publish_time,
                    log_ns=record.log_time,
                    payload=payload,
                )
    except InputError:
        raise
    except Exception as error:  # bad bytes may raise any exception inside the library
        raise _damaged(file.file, error) from error
