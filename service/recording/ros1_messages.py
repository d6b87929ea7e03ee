"""Messages as ROS 1 writes them, in bags and in MCAP, as those of ROS 2."""

from service.encoding import TF, from_ros1
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
