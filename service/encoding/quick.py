"""Samples and poses as CDR, each by a few struct calls: they come hundreds of times a second.

The type store of rosbags goes field by field through objects; for these messages that was most of what a
sample costs. Bytes and values are the same. What is laid out otherwise (big endian, another length) is left
to it.

Source: OMG DDS-XTYPES 1.3, 7.4.1 (plain CDR): each number at a multiple of its size, counted from behind the
4 bytes of the header; a text with its length and a closing zero.
"""

import math
import struct
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from service.geometry.se2 import SE2

_HEADER = b"\x00\x01\x00\x00"  # CDR, little endian
_STAMP = struct.Struct("<4siI")  # CDR header, s, ns
_EDGE_STAMP = struct.Struct("<iI")
_SIZE = struct.Struct("<I")
_POSE, _TWIST = struct.Struct("<7d"), struct.Struct("<6d")
_IMU = struct.Struct("<37d")  # orientation, covariance, rate, covariance, force, covariance
_ODOMETRY = struct.Struct("<7d36d6d36d")

FloatArray = npt.NDArray[np.float64]


def odometry(
    stamp_ns: int,
    frames: tuple[str, str],
    pose: SE2,
    covariance_36: FloatArray,
    twist: tuple[float, float, float],
    twist_covariance_36: bytes,
) -> bytes:
    """nav_msgs/Odometry of header.frame_id and child_frame_id; twist: m/s forward, m/s left, rad/s."""
    forward, left, turn = twist
    s, c = math.sin(pose.theta_rad / 2.0), math.cos(pose.theta_rad / 2.0)
    return b"".join(
        (
            _STAMP.pack(_HEADER, *divmod(stamp_ns, 1_000_000_000)),
            _texts(_STAMP.size, *frames),
            _POSE.pack(pose.x_m, pose.y_m, 0.0, 0.0, 0.0, s, c),
            covariance_36.tobytes(),
            _TWIST.pack(forward, left, 0.0, 0.0, 0.0, turn),
            twist_covariance_36,
        )
    )


def transforms(stamp_ns: int, edges: Sequence[tuple[str, str, SE2]]) -> bytes:
    """tf2_msgs/TFMessage of (frame, child, pose_frame_child), all in the plane."""
    stamp = _EDGE_STAMP.pack(*divmod(stamp_ns, 1_000_000_000))
    payload = bytearray(_HEADER + _SIZE.pack(len(edges)))
    for frame, child, pose in edges:
        s, c = math.sin(pose.theta_rad / 2.0), math.cos(pose.theta_rad / 2.0)
        payload += stamp
        payload += _texts(len(payload), frame, child)
        payload += _POSE.pack(pose.x_m, pose.y_m, 0.0, 0.0, 0.0, s, c)
    return bytes(payload)


def imu(stamp_ns: int, frame: str, values: Sequence[float]) -> bytes:
    """sensor_msgs/Imu; values: its 37 numbers in their order."""
    stamp = _STAMP.pack(_HEADER, *divmod(stamp_ns, 1_000_000_000))
    return stamp + _texts(_STAMP.size, frame) + _IMU.pack(*values)


def read_imu(payload: bytes) -> tuple[int, tuple[float, ...]] | None:
    """Stamp, ns, and the 37 numbers of a sensor_msgs/Imu; None where it is not laid out like that."""
    at = _end_of_text(payload, _STAMP.size)
    if at is None or (at := _aligned(at, 8)) + _IMU.size != len(payload):
        return None
    return _stamp_ns(payload), _IMU.unpack_from(payload, at)


def read_odometry(payload: bytes) -> tuple[int, tuple[float, ...]] | None:
    """Stamp, ns, and the 85 numbers of a nav_msgs/Odometry; None where it is not laid out like that."""
    at = _end_of_text(payload, _STAMP.size)
    if at is not None:
        at = _end_of_text(payload, _aligned(at, 4))
    if at is None or (at := _aligned(at, 8)) + _ODOMETRY.size != len(payload):
        return None
    return _stamp_ns(payload), _ODOMETRY.unpack_from(payload, at)


@lru_cache(maxsize=256)
def _texts(at: int, *texts: str) -> bytes:
    """Texts that begin there in the payload, and what is left free up to the first double behind them."""
    content = b""
    for text in texts:
        encoded = text.encode() + b"\x00"
        content += bytes(-(at + len(content)) % 4) + _SIZE.pack(len(encoded)) + encoded
    return content + bytes(_aligned(at + len(content), 8) - at - len(content))


def _stamp_ns(payload: bytes) -> int:
    _, seconds, nanoseconds = _STAMP.unpack_from(payload)
    return int(seconds * 1_000_000_000 + nanoseconds)


def _end_of_text(payload: bytes, at: int) -> int | None:
    """None where there is no plain text, or no plain CDR."""
    if payload[:2] != _HEADER[:2] or at + _SIZE.size > len(payload):
        return None
    (size,) = _SIZE.unpack_from(payload, at)
    end: int = at + _SIZE.size + size
    text = payload[at + _SIZE.size : end]
    return end if size and end <= len(payload) and text.isascii() and text.find(b"\x00") == size - 1 else None


def _aligned(at: int, size: int) -> int:
    return at + -(at - len(_HEADER)) % size
