"""Types of messages in recordings: names and definitions as writers of ROS 1 and ROS 2 have them."""

from functools import lru_cache
from typing import Any

from rosbags.typesys import TypesysError, get_types_from_msg

from service.encoding import TF, from_ros1, schema_text
from service.encoding.ros_messages import FIELDDEFS
from service.errors import InputError

OLD_TF = "tf/msg/tfMessage"  # of tf 1; the same fields as tf2_msgs'


def ros2_type(name: str) -> str:
    """The type of ROS 2 that has the fields of one of ROS 1."""
    return TF if name == OLD_TF else name


def cdr_of_ros1(type_name: str, raw: bytes) -> bytes:
    """Of bytes that are no such message b"", which no decoder takes."""
    try:
        return from_ros1(type_name, raw)
    except InputError:
        return b""


@lru_cache(maxsize=64)
def is_known(type_name: str, definition: str) -> bool:
    """Whether a recording's own definition of a type (.msg of ROS 1 or ROS 2) has the fields that are read
    here; also where it has none, cannot be parsed, or the type is not read.
    """
    if ros2_type(type_name) not in FIELDDEFS or definition in ("", schema_text(ros2_type(type_name))):
        return True
    try:
        types = get_types_from_msg(definition, type_name)
    except TypesysError:
        return True
    return all(_same_fields(name, fields) for name, (_, fields) in types.items())


def _same_fields(name: str, fields: list[Any]) -> bool:
    """ROS 1 has a seq in its header besides."""
    ours = FIELDDEFS.get(ros2_type(name))
    return ours is not None and [field for field in fields if field[0] != "seq"] == ours[1]
