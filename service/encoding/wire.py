"""ROS 2 messages as bytes: the types used, their definitions, and the parts all of them share."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from drivers.counted import counted
from service.encoding import quick
from service.encoding import ros_messages as ros
from service.errors import InputError
from service.geometry.se2 import SE2

LASER_SCAN = "sensor_msgs/msg/LaserScan"
MULTI_ECHO_SCAN = "sensor_msgs/msg/MultiEchoLaserScan"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
IMU = "sensor_msgs/msg/Imu"
ODOMETRY = "nav_msgs/msg/Odometry"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
INITIAL_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
TF = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
MARKERS = "visualization_msgs/msg/MarkerArray"
STRING = "std_msgs/msg/String"
BYTES = "std_msgs/msg/UInt8MultiArray"

MAP_FRAME, ODOM_FRAME, BASE_FRAME = "map", "odom", "base_link"  # ROS REP 105

ANGLE_GRID = 2.0**40  # decoded headings are multiples of 1/ANGLE_GRID rad, far coarser than rounding errors
LARGEST_ANGLE = math.floor(math.pi * ANGLE_GRID) / ANGLE_GRID

FloatArray = npt.NDArray[np.float64]
_PLANAR = np.array([0, 1, 5])  # x, y, yaw within ROS' (x, y, z, roll, pitch, yaw)
PLANAR_CELLS = (_PLANAR[:, None] * 6 + _PLANAR).ravel()  # the 9 cells of the planar block in the 36
PLANAR_CELLS_OF_36: tuple[int, ...] = tuple(PLANAR_CELLS.tolist())
NOT_KNOWN = 1e6  # m^2, rad^2: a variance that says so, as in drivers of planar bases; 0 would say "exact"
NOT_KNOWN_36 = NOT_KNOWN * np.eye(6).ravel()
_NOT_KNOWN_BYTES = NOT_KNOWN_36.tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One encoded message for subscribers and the recorder.

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

    def __reduce__(self) -> tuple[Callable[..., "Message"], tuple[str, str, int, int, bytes]]:
        """Every pose crosses from one process to another; field by field that takes three times as long."""
        return Message, (self.channel, self.type, self.stamp_ns, self.log_ns, self.payload)


class LogClock:
    """Log times that rise strictly, so that sorting a recording by log time gives back the order of use.

    Frames of several devices reach the mapper in an order that their arrival times need not have. Whoever
    fixes that order asks here for each frame's log_ns, before encoding: the frame then carries it as
    `arrived_ns`, live and in the replay.
    """

    def __init__(self) -> None:
        self._last_ns = 0

    def next_ns(self, unix_ns: int) -> int:
        """`unix_ns`, or two more than the last log time where that is later.

        The time one before a frame's own is free for what the mapper decided when it came to that frame.
        """
        self._last_ns = max(self._last_ns + 2, unix_ns)
        return self._last_ns


@lru_cache(maxsize=1)
def store() -> Typestore:
    """The messages of the wire."""
    return Typestore(ros)


def schema_text(type_name: str) -> str:
    """The definition of a message type with all it contains, as MCAP's `ros2msg` schema encoding wants it."""
    return store().generate_msgdef(type_name, ros_version=2)[0]


def type_hash(type_name: str) -> str:
    """ROS 2 type hash (REP 2011), "RIHS01_..."."""
    return store().hash_rihs01(type_name)


def to_message(channel: str, type_name: str, stamp_ns: int, log_ns: int, content: object) -> Message:
    """Encode a message object of rosbags' type store."""
    payload = bytes(store().serialize_cdr(content, type_name, little_endian=True))
    return Message(channel, type_name, stamp_ns, log_ns, payload)


def read(type_name: str, payload: bytes) -> object:
    """The message object of a payload. Raises InputError where the bytes are no such message."""
    try:
        return store().deserialize_cdr(payload, type_name)
    except SerdeError as error:
        raise InputError(
            f"{counted(len(payload), 'byte')} cannot be read as a {type_name}: {error}"
        ) from error


def from_ros1(type_name: str, payload: bytes) -> bytes:
    """A message as ROS 1 writes it, as CDR. Raises InputError where the bytes are no such message."""
    try:
        return bytes(store().ros1_to_cdr(payload, type_name))
    except (SerdeError, AssertionError) as error:
        raise InputError(
            f"{counted(len(payload), 'byte')} cannot be read as a {type_name} of ROS 1: {error}"
        ) from error


def time_ros(stamp_ns: int) -> ros.builtin_interfaces__msg__Time:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return ros.builtin_interfaces__msg__Time(seconds, nanoseconds)


def header_ros(stamp_ns: int, frame: str) -> ros.std_msgs__msg__Header:
    return ros.std_msgs__msg__Header(time_ros(stamp_ns), frame)


def stamp_ns_of(time: ros.builtin_interfaces__msg__Time) -> int:
    return int(time.sec * 1_000_000_000 + time.nanosec)


def odometry_payload(
    stamp_ns: int,
    frame: str,
    pose: SE2,
    covariance: Sequence[float] | FloatArray,
    twist: tuple[float, float, float],
) -> bytes:
    """nav_msgs/Odometry of the base in that frame.

    covariance: the 9 values of x, y, theta, in the axes of the frame. No one knows that of the twist, nor
    what the plane leaves open.
    """
    covariance_36 = NOT_KNOWN_36.copy()
    covariance_36[PLANAR_CELLS] = covariance
    return quick.odometry(stamp_ns, (frame, BASE_FRAME), pose, covariance_36, twist, _NOT_KNOWN_BYTES)


def planar_pose_ros(pose: SE2) -> ros.geometry_msgs__msg__Pose:
    return ros.geometry_msgs__msg__Pose(
        ros.geometry_msgs__msg__Point(pose.x_m, pose.y_m, 0.0), quaternion_ros(pose.theta_rad)
    )


def planar_pose(pose: ros.geometry_msgs__msg__Pose) -> SE2:
    return SE2(pose.position.x, pose.position.y, yaw(pose.orientation))


def pose_on_wire(pose: SE2) -> SE2:
    """The pose as whoever decodes the message has it: its heading has been a quaternion."""
    return planar_pose(planar_pose_ros(pose))


def quaternion_ros(theta_rad: float) -> ros.geometry_msgs__msg__Quaternion:
    return ros.geometry_msgs__msg__Quaternion(0.0, 0.0, math.sin(theta_rad / 2.0), math.cos(theta_rad / 2.0))


def yaw(q: ros.geometry_msgs__msg__Quaternion) -> float:
    """Heading of a rotation, NaN for none; on a grid, so that encoding and decoding it again is exact."""
    heading_rad = math.atan2(2.0 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)
    if not math.isfinite(heading_rad) or not any((q.w, q.x, q.y, q.z)):
        return math.nan
    return max(-LARGEST_ANGLE, min(LARGEST_ANGLE, round(heading_rad * ANGLE_GRID) / ANGLE_GRID))


def rotation_3x3(theta_rad: float) -> FloatArray:
    """For covariances of (x, y, theta): R C R^T takes C from the turned frame's axes to the fixed ones."""
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def all_finite(*values: float) -> bool:
    return all(map(math.isfinite, values))
