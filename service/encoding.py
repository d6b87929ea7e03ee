"""Frames and outputs <-> ROS 2 CDR: the one wire format, for Zenoh and for recordings alike."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One encoded message on its way to subscribers and to the recorder.

    channel    below `corridor/v1/<vehicle>/` on Zenoh, below `/` as a ROS topic: "front/scan", "pose", "tf"
    type       ROS 2 name, e.g. "sensor_msgs/msg/LaserScan"
    stamp_ns   Unix time of the measurement: header.stamp, MCAP publish_time
    log_ns     Unix time when the service had it: MCAP log_time
    payload    CDR, little endian, with its 4-byte header
    """

    channel: str
    type: str
    stamp_ns: int
    log_ns: int
    payload: bytes
