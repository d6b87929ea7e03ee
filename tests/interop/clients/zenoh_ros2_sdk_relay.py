"""A node with a laser: publishes the scans of one topic on another, read and written by the SDK."""

import sys

from rosbags.typesys import Stores, get_typestore
from telling import facts
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber

KIND = "sensor_msgs/msg/LaserScan"
JAZZY = get_typestore(Stores.ROS2_JAZZY)
WANTED = facts()
COMMON = {
    "msg_type": KIND,
    "msg_definition": JAZZY.generate_msgdef(KIND, ros_version=2)[0],
    "type_hash": JAZZY.hash_rihs01(KIND),
    "router_ip": "127.0.0.1",
    "router_port": WANTED["port"],
    "domain_id": WANTED["domain"],
}
publisher = ROS2Publisher(topic=WANTED["to"], **COMMON)


def relay(scan: object) -> None:
    publisher.publish(**{name: getattr(scan, name) for name in type(scan).__annotations__ if name[0] != "_"})


subscriber = ROS2Subscriber(topic=WANTED["from"], callback=relay, **COMMON)
print("relays", flush=True)
sys.stdin.read()  # until it is ended
