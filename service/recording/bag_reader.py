"""Reads bags of ROS 1 and db3 files of ROS 2 as one stream of ROS 2 messages.

ROS 1 messages are converted to CDR.
"""

import heapq
import re
import sqlite3
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import ReaderError
from rosbags.rosbag2 import Reader as Ros2Reader

from service.encoding import Message
from service.encoding.ros_messages import FIELDDEFS
from service.errors import InputError
from service.recording.definitions import cdr_of_ros1, is_known, ros2_type
from service.recording.mcap_reader import ANOTHER, Topic
from service.recording.ros1_scan import Scan, ScannedReader, scan_bag, unpacked_chunk
from service.recording.unpacking import ROS1, SQLITE, Unpacked, plain


class Bag:
    """Files of one bag as `mcap_source` wants a recording: NAME.bag of ROS 1, NAME.db3 of ROS 2. Opened for
    each walk through them, and closed after. Given are those messages whose types the service knows.

    A bag of ROS 1 without an index is read by a scan of its chunks; `losses` reports the outcome.

    Raises InputError for a bag that is missing, no bag, or broken.
    """

    def __init__(self, files: Sequence[Unpacked]) -> None:
        self.paths = [file.given for file in files]
        self.library = "rosbag"
        self.metadata: dict[str, dict[str, str]] = {}
        self.losses: list[str] = []
        self._files = files
        self._scans: dict[Path, Scan] = {}
        counts: defaultdict[tuple[str, str], int] = defaultdict(int)
        spans: list[tuple[int, int]] = []
        self._unknown: set[str] = set()
        for file in files:
            self.losses += file.losses
            self._scan_if_needed(file)
            with self._reading(file) as reader:
                if reader.message_count:
                    spans.append((reader.start_time, reader.end_time - 1))
                for connection in reader.connections:
                    counts[connection.topic, ros2_type(connection.msgtype)] += connection.msgcount
                self._unknown |= {c.topic for c in reader.connections if not _is_known(c)}
        self.first_log_ns = min((first for first, _ in spans), default=0)
        self.last_log_ns = max((last for _, last in spans), default=0)
        self.topics = [
            Topic(name, type_name, "cdr" if name not in self._unknown else ANOTHER, n)
            for (name, type_name), n in sorted(counts.items())
        ]

    def messages(
        self, topics: Collection[str] | None = None, from_ns: int | None = None, to_ns: int | None = None
    ) -> Iterator[Message]:
        """Messages by rising time of recording, as of mcap_reader.Recording. Raises InputError at a damaged
        place.
        """
        streams = [self._of_file(file, topics, from_ns, to_ns) for file in self._files]
        return heapq.merge(*streams, key=lambda message: message.log_ns)

    def _of_file(
        self, file: Unpacked, topics: Collection[str] | None, from_ns: int | None, to_ns: int | None
    ) -> Iterator[Message]:
        with self._reading(file) as reader:
            wanted = [
                connection
                for connection in reader.connections
                if ros2_type(connection.msgtype) in FIELDDEFS
                and (topics is None or connection.topic in topics)
                and connection.topic not in self._unknown
            ]
            if not wanted:  # rosbags takes none for all
                return
            until_ns = None if to_ns is None else to_ns + 1
            for connection, log_ns, raw in reader.messages(wanted, from_ns, until_ns):
                type_name = ros2_type(connection.msgtype)
                yield Message(
                    channel=connection.topic.removeprefix("/"),
                    type=type_name,
                    stamp_ns=log_ns,
                    log_ns=log_ns,
                    payload=cdr_of_ros1(type_name, raw) if file.kind == ROS1 else plain(bytes(raw)),
                )

    def _scan_if_needed(self, file: Unpacked) -> None:
        if file.kind != ROS1:
            return
        try:
            with Ros1Reader(file.path):
                return
        except Exception:  # a broken index may raise any exception inside the library
            try:
                scan = scan_bag(file.path)
            except (OSError, ValueError, ReaderError):
                return  # its fault is found again, and reported, when it is read
            if scan.messages:
                self._scans[file.path] = scan
                self.losses.append(f"{file.given} was not closed, or is cut off or damaged: {scan}")

    @contextmanager
    def _reading(self, file: Unpacked) -> Iterator[Ros1Reader | Ros2Reader]:
        try:
            if file.path in self._scans:
                reader: Ros1Reader | Ros2Reader = ScannedReader(file.path, self._scans[file.path])
            else:
                reader = Ros1Reader(file.path) if file.kind == ROS1 else Ros2Reader(file.path)
            if file.kind == SQLITE:
                refuse_other_than_tables(file.path)
            with reader:
                if isinstance(reader, Ros1Reader):
                    chunks = reader.chunks.items()
                    reader.chunks = {at: c._replace(decompressor=unpacked_chunk) for at, c in chunks}
                yield reader
        except InputError:
            raise
        except OSError as error:
            raise InputError(f"cannot read {file.given}: {error.strerror or error}") from error
        except Exception as error:  # as above
            raise InputError(
                f"{file.given} cannot be read as a {'ROS 1' if file.kind == ROS1 else 'ROS 2'} bag: "
                f"{error or type(error).__name__}"
            ) from error


def refuse_other_than_tables(path: Path) -> None:
    """A view, or a column that is computed, may have rows without end. Raises InputError."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as database:
        for kind, name, sql in database.execute("SELECT type, name, sql FROM sqlite_master"):
            if kind not in ("table", "index") or re.search(r"\bAS\b|VIRTUAL", str(sql), re.IGNORECASE):
                raise InputError(f"{path}: {name!r} is computed as it is read; expected tables alone")


def _is_known(connection: Connection) -> bool:
    is_text = connection.msgdef.format == MessageDefinitionFormat.MSG
    return not is_text or is_known(connection.msgtype, connection.msgdef.data)
