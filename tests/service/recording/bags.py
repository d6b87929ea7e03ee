"""Messages as bags of ROS 1 and ROS 2, by rosbags' writers and its definitions of Noetic and Humble."""

from collections.abc import Iterable
from pathlib import Path

from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.rosbag2.enums import CompressionFormat
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from service.encoding import TF, Message

OLD_TF, TRANSFORMS = "tf/msg/tfMessage", "geometry_msgs/TransformStamped[] transforms"


def noetic() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    for name in (OLD_TF, TF):  # not in rosbags' Noetic
        store.register(get_types_from_msg(TRANSFORMS, name))
    return store


def write_ros1(
    path: Path,
    messages: Iterable[Message],
    compression: Ros1Writer.CompressionFormat | None = None,
    chunk_bytes: int = 50_000,
) -> Path:
    """NAME.bag, in chunks of about so many bytes."""
    store, known = noetic(), {}
    writer, humble = Ros1Writer(path), get_typestore(Stores.ROS2_HUMBLE)
    humble.register(get_types_from_msg(TRANSFORMS, OLD_TF))
    writer.chunk_threshold = chunk_bytes
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        for m in messages:
            if m.channel not in known:
                known[m.channel] = writer.add_connection(f"/{m.channel}", m.type, typestore=store)
            writer.write(known[m.channel], m.log_ns, humble.cdr_to_ros1(m.payload, m.type))
    return path


def write_ros1_mcap(path: Path, messages: Iterable[Message]) -> Path:
    """As `mcap convert` makes it of a bag of ROS 1."""
    humble = get_typestore(Stores.ROS2_HUMBLE)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros1", library="mcap go")
        known: dict[str, int] = {}
        for m in messages:
            if m.channel not in known:
                schema = writer.register_schema(m.type.replace("/msg/", "/"), "ros1msg", b"")
                known[m.channel] = writer.register_channel(f"/{m.channel}", "ros1", schema)
            raw = bytes(humble.cdr_to_ros1(m.payload, m.type))
            writer.add_message(known[m.channel], m.log_ns, raw, m.log_ns)
        writer.finish()
    return path


def write_ros2(
    path: Path,
    messages: Iterable[Message],
    plugin: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode | None = None,
) -> Path:
    """A folder with metadata.yaml and one file."""
    store, known = get_typestore(Stores.ROS2_HUMBLE), {}
    writer = Ros2Writer(path, version=9, storage_plugin=plugin)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for m in messages:
            if m.channel not in known:
                known[m.channel] = writer.add_connection(f"/{m.channel}", m.type, typestore=store)
            writer.write(known[m.channel], m.log_ns, m.payload)
    return path
