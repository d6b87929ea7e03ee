"""Recordings as other ROS 2 programs write them."""

import math

from mcap.writer import Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.stores import ros2_jazzy as ros

from service import encoding
from service.encoding import Message
from tests.service.recording.sessions import T0_NS

STORE = get_typestore(Stores.ROS2_JAZZY)


def turn(roll=0.0, pitch=0.0, yaw=0.0):
    """Quaternion (w, x, y, z) of roll, pitch or yaw in degrees about one axis."""
    half = [math.radians(angle) / 2 for angle in (roll, pitch, yaw)]
    w = math.cos(sum(half))
    return (w, *(math.sin(angle) for angle in half))


LEVEL = turn()


def tf_payload(stamp_ns, *edges):
    """Each edge: parent, child, (x, y, z), quaternion (w, x, y, z)."""
    stamp = ros.builtin_interfaces__msg__Time(*divmod(stamp_ns, 10**9))
    transforms = [
        ros.geometry_msgs__msg__TransformStamped(
            ros.std_msgs__msg__Header(stamp, parent),
            child,
            ros.geometry_msgs__msg__Transform(
                ros.geometry_msgs__msg__Vector3(*xyz), ros.geometry_msgs__msg__Quaternion(x, y, z, w)
            ),
        )
        for parent, child, xyz, (w, x, y, z) in edges
    ]
    return bytes(STORE.serialize_cdr(ros.tf2_msgs__msg__TFMessage(transforms), encoding.TF))


class Foreign:
    """A recording as another ROS 2 program writes it."""

    def __init__(self, path):
        self.path = path
        self._stream = path.open("wb")
        self._writer = Writer(self._stream)
        self._writer.start(profile="ros2", library="rosbag2")
        self._channels = {}

    def add(self, topic, type_name, payload, log_ns=T0_NS, encoding_name="cdr"):
        if (key := (topic, type_name)) not in self._channels:
            schema = self._writer.register_schema(type_name, "ros2msg", b"")
            self._channels[key] = self._writer.register_channel(topic, encoding_name, schema)
        self._writer.add_message(self._channels[key], log_ns, payload, log_ns)
        return self

    def add_message(self, topic, message: Message):
        return self.add(topic, message.type, message.payload, message.log_ns)

    def tf(self, *edges):
        """Edges of the tree of frames, as for tf_payload."""
        return self.add("/tf_static", encoding.TF, tf_payload(0, *edges))

    def close(self):
        self._writer.finish()
        self._stream.close()
        return [self.path]
