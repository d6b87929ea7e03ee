"""One MCAP file of a session while it is written: `*.mcap.active`, locked, renamed when it is complete."""

import fcntl
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from service.encoding import CHANGES, Message, schema_text, type_hash
from service.version import VERSION
from service.writable import sync

ACTIVE_SUFFIX = ".active"
PROFILE = "ros2"
LIBRARY = f"corridor {VERSION}"
CHUNK_BYTES = 1 << 20
# Transient local in ROS: the last one is there for late joiners.
LATCHED = frozenset({"tf_static", "map", "graph", CHANGES})

_QOS = """- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {{sec: 9223372036, nsec: 854775807}}
  lifespan: {{sec: 9223372036, nsec: 854775807}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 9223372036, nsec: 854775807}}
  avoid_ros_namespace_conventions: false"""  # rosbag2's YAML: keep last, reliable, no deadlines

StreamOpener = Callable[[Path], BinaryIO]


def create_stream(path: Path) -> BinaryIO:
    """A new file; an existing one is never overwritten."""
    return path.open("xb")


def is_locked(path: Path) -> bool:
    """Whether a living process is writing this file."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


class McapFile:
    """path is what it will be called when complete.

    Raises OSError from every method but `abandon`, as the disk does.
    """

    def __init__(self, path: Path, first_log_ns: int, open_stream: StreamOpener = create_stream) -> None:
        self.path = path
        self.active_path = path.with_name(path.name + ACTIVE_SUFFIX)
        self.first_log_ns = first_log_ns
        self._channel_ids: dict[str, int] = {}
        self._schema_ids: dict[str, int] = {}
        self._sequences: dict[str, int] = {}
        self._first_message_at: int | None = None  # bytes before it: header and metadata
        self._stream = open_stream(self.active_path)
        try:
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile=PROFILE, library=LIBRARY)
        except OSError:
            self._stream.close()
            raise

    @property
    def size(self) -> int:
        """Bytes so far, without the chunk in memory."""
        return self._stream.tell()

    def write(self, message: Message, log_ns: int | None = None) -> None:
        """Append a message; log_ns replaces its log time where it is repeated from an earlier file."""
        if self._first_message_at is None:
            self._first_message_at = self._stream.tell()
        channel_id = self._channel_ids.get(message.channel)
        if channel_id is None:
            channel_id = self._register(message.channel, message.type)
        sequence = self._sequences.get(message.channel, 0) + 1
        self._sequences[message.channel] = sequence
        self._writer.add_message(
            channel_id,
            log_time=message.log_ns if log_ns is None else log_ns,
            data=message.payload,
            publish_time=message.stamp_ns,
            sequence=sequence,
        )

    def write_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """What is no text, such as the name of a file in Latin-1, becomes one with escapes."""
        texts = {key: value.encode(errors="backslashreplace").decode() for key, value in values.items()}
        self._writer.add_metadata(name, texts)

    def sync(self) -> None:
        """Put everything written so far on the disk."""
        self._writer.flush()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
        os.fsync(self._stream.fileno())

    def finish(self) -> None:
        """Complete the file with its index and rename it to its final name."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self.active_path.rename(self.path)
        self._stream.close()
        sync(self.path.parent)

    def abandon(self) -> None:
        """Close a file after an error of the disk; it stays as `*.active` if it holds a message.

        Raises nothing: the disk has reported its error.
        """
        with suppress(OSError):
            self._stream.close()
        with suppress(OSError):
            before_messages = self._first_message_at
            if before_messages is None or self.active_path.stat().st_size <= before_messages:
                self.active_path.unlink()

    def _register(self, channel: str, type_name: str) -> int:
        schema_id = self._schema_ids.get(type_name)
        if schema_id is None:
            schema_id = self._writer.register_schema(type_name, "ros2msg", schema_text(type_name).encode())
            self._schema_ids[type_name] = schema_id
        latched = channel in LATCHED
        channel_id = self._writer.register_channel(
            f"/{channel}",
            "cdr",
            schema_id,
            {
                "offered_qos_profiles": _QOS.format(
                    depth=1 if latched else 10, durability=1 if latched else 2
                ),
                "topic_type_hash": type_hash(type_name),
            },
        )
        self._channel_ids[channel] = channel_id
        return channel_id
