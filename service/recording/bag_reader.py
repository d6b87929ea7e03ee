"""Reads ROS 1 bags and ROS 2 bags (db3, mcap, folders with metadata.yaml) as one stream of ROS 2 messages.

What is read are the types a mapper can use; ROS 1 messages are turned into CDR on the way. Old robots say
their odometry in /tf only: where a bag has no Odometry, the edge from odom to the base becomes one.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Ros2Reader
from rosbags.typesys import get_types_from_msg

from drivers.frames import OdometrySample
from service.encoding import (
    BASE_FRAME,
    IMU,
    LASER_SCAN,
    NAV_SAT_FIX,
    ODOM_FRAME,
    ODOMETRY,
    TF,
    Message,
    decode_transforms,
    encode_frame,
    from_ros1,
)
from service.encoding.ros_messages import FIELDDEFS
from service.errors import InputError
from service.recording.mcap_reader import Topic

READ = frozenset({LASER_SCAN, IMU, ODOMETRY, NAV_SAT_FIX, TF})
OLD_TF = "tf/msg/tfMessage"  # of tf 1; the same fields as tf2_msgs'
ROS1_SUFFIX = ".bag"
ODOM_FRAMES = (ODOM_FRAME, "odom_combined")
MOVED_FRAMES = ("base_footprint", BASE_FRAME)
ODOM_OF_TF = "/tf/odom"  # the topic that the odometry in /tf is given out as; no bag can have it besides /tf


class Bag:
    """A bag as `mcap_source` wants a recording. Opened for each walk through it, and closed after.

    Raises InputError for a bag that is missing, no bag, unfinished or broken.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.paths = [path]
        self.library = "rosbag"
        self.metadata: dict[str, dict[str, str]] = {}
        self._is_ros1 = path.suffix == ROS1_SUFFIX
        if path.is_dir() and not (path / "metadata.yaml").is_file():
            raise InputError(
                f"{path}: no metadata.yaml in this folder, which the folder of a ROS 2 bag has; "
                "`ros2 bag reindex` writes it anew, and NAME.db3 or NAME.mcap in it can be named instead"
            )
        counts: defaultdict[tuple[str, str], int] = defaultdict(int)
        with self._reading() as reader:
            self.first_log_ns, self.last_log_ns = reader.start_time, reader.end_time
            for connection in reader.connections:
                counts[connection.topic, _type_of(connection)] += connection.msgcount
            self._unknown = {c.topic for c in reader.connections if _type_of(c) in READ and not _is_known(c)}
        self.topics = [
            Topic(name, type_name, "cdr" if name not in self._unknown else "another message of its name", n)
            for (name, type_name), n in sorted(counts.items())
        ]
        if not any(topic.type == ODOMETRY and topic.count for topic in self.topics):
            self._find_odometry_in_tf()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Message]:
        """Messages by rising time of recording, of types in READ. Raises InputError at a damaged place."""
        if topics is not None and ODOM_OF_TF in topics:
            tf = {topic.name for topic in self._moving_tf()}
            for message in self._stored(tf.union(topics)):
                if f"/{message.channel}" in topics:
                    yield message
                if f"/{message.channel}" in tf:
                    yield from _odometry(message)
        else:
            yield from self._stored(topics)

    def _stored(self, topics: Collection[str] | None) -> Iterator[Message]:
        with self._reading() as reader:
            wanted = [
                connection
                for connection in reader.connections
                if _type_of(connection) in READ
                and (topics is None or connection.topic in topics)
                and connection.topic not in self._unknown
            ]
            if not wanted:  # rosbags takes none for all
                return
            for connection, log_ns, raw in reader.messages(connections=wanted):
                yield Message(
                    channel=connection.topic.removeprefix("/"),
                    type=_type_of(connection),
                    stamp_ns=log_ns,
                    log_ns=log_ns,
                    payload=self._cdr(raw, _type_of(connection)),
                )

    def _cdr(self, raw: bytes, type_name: str) -> bytes:
        """Of bytes that are no such message b"", which no decoder takes."""
        try:
            return from_ros1(type_name, raw) if self._is_ros1 else bytes(raw)
        except InputError:
            return b""

    def _moving_tf(self) -> list[Topic]:
        return [t for t in self.topics if t.type == TF and not t.name.endswith("tf_static") and t.count]

    def _find_odometry_in_tf(self) -> None:
        tf = [topic.name for topic in self._moving_tf()]
        samples = sum(len(_odometry(message)) for message in self._stored(tf)) if tf else 0
        if samples:
            self.topics.append(Topic(ODOM_OF_TF, ODOMETRY, "cdr", samples))

    @contextmanager
    def _reading(self) -> Iterator[Ros1Reader | Ros2Reader]:
        try:
            reader = Ros1Reader(self.path) if self._is_ros1 else Ros2Reader(self.path)
            with reader:
                yield reader
        except InputError:
            raise
        except OSError as error:
            raise InputError(f"cannot read {self.path}: {error.strerror or error}") from error
        except Exception as error:  # a broken index may fail in any way inside the library
            raise InputError(
                f"{self.path} cannot be read as a {'ROS 1' if self._is_ros1 else 'ROS 2'} bag: "
                f"{error or type(error).__name__}; expected NAME.bag of ROS 1 (`rosbag reindex` mends one "
                "that was cut off), or NAME.db3, NAME.mcap or a folder with metadata.yaml of ROS 2"
            ) from error


def _type_of(connection: Connection) -> str:
    return TF if connection.msgtype == OLD_TF else connection.msgtype


def _is_known(connection: Connection) -> bool:
    """Whether the bag's own definition of a type has the fields that are read here."""
    if connection.msgdef.format != MessageDefinitionFormat.MSG:
        return True
    types = get_types_from_msg(connection.msgdef.data, connection.msgtype)
    return all(_same_fields(name, fields) for name, (_, fields) in types.items())


def _same_fields(name: str, fields: list[Any]) -> bool:
    """ROS 1 has a seq in its header besides."""
    ours = FIELDDEFS.get(TF if name == OLD_TF else name)
    return ours is not None and [field for field in fields if field[0] != "seq"] == ours[1]


def _odometry(tf: Message) -> list[Message]:
    """The edges of a TFMessage that say where the base is by odometry, as Odometry."""
    try:
        said = decode_transforms(tf.payload)
    except InputError:
        return []
    samples = []
    for edge in [e for e in said if e.frame in ODOM_FRAMES and e.child in MOVED_FRAMES]:
        x_m, y_m, heading_rad = edge.pose.x_m, edge.pose.y_m, edge.pose.theta_rad
        sample = OdometrySample(
            "tf", edge.stamp_ns, tf.log_ns, x_m, y_m, heading_rad, (0.0, 0.0, 0.0), (0.0,) * 9
        )
        samples.append(encode_frame(sample))
    return samples
