"""The ROS 2 messages that go over the wire, as rosbags' type store wants them.

rosbags brings all messages of ROS 2 Jazzy, and of each release before it, as classes made at import: 0.2 s of
every start. These are those that are used, with the names and fields that they have there.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from rosbags.interfaces import Nodetype

from service.encoding.ros_markers import (
    DEFINITIONS as MARKER_DEFINITIONS,
)
from service.encoding.ros_markers import (
    builtin_interfaces__msg__Duration as builtin_interfaces__msg__Duration,
)
from service.encoding.ros_markers import (
    sensor_msgs__msg__CompressedImage as sensor_msgs__msg__CompressedImage,
)
from service.encoding.ros_markers import (
    std_msgs__msg__ColorRGBA as std_msgs__msg__ColorRGBA,
)
from service.encoding.ros_markers import (
    visualization_msgs__msg__Marker as visualization_msgs__msg__Marker,
)
from service.encoding.ros_markers import (
    visualization_msgs__msg__MarkerArray as visualization_msgs__msg__MarkerArray,
)
from service.encoding.ros_markers import (
    visualization_msgs__msg__MeshFile as visualization_msgs__msg__MeshFile,
)
from service.encoding.ros_markers import (
    visualization_msgs__msg__UVCoordinate as visualization_msgs__msg__UVCoordinate,
)

# ROS names of the classes have two underscores between package and message, as in rosbags.


@dataclass
class builtin_interfaces__msg__Time:  # noqa: N801
    sec: int
    nanosec: int
    __msgtype__: ClassVar[str] = "builtin_interfaces/msg/Time"


@dataclass
class std_msgs__msg__Header:  # noqa: N801
    stamp: builtin_interfaces__msg__Time
    frame_id: str
    __msgtype__: ClassVar[str] = "std_msgs/msg/Header"


@dataclass
class sensor_msgs__msg__LaserScan:  # noqa: N801
    header: std_msgs__msg__Header
    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    scan_time: float
    range_min: float
    range_max: float
    ranges: npt.NDArray[np.float32]
    intensities: npt.NDArray[np.float32]
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/LaserScan"


@dataclass
class sensor_msgs__msg__LaserEcho:  # noqa: N801
    echoes: npt.NDArray[np.float32]
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/LaserEcho"


@dataclass
class sensor_msgs__msg__MultiEchoLaserScan:  # noqa: N801
    header: std_msgs__msg__Header
    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment: float
    scan_time: float
    range_min: float
    range_max: float
    ranges: list[sensor_msgs__msg__LaserEcho]
    intensities: list[sensor_msgs__msg__LaserEcho]
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/MultiEchoLaserScan"


@dataclass
class sensor_msgs__msg__PointField:  # noqa: N801
    name: str
    offset: int
    datatype: int
    count: int
    INT8: ClassVar[int] = 1
    UINT8: ClassVar[int] = 2
    INT16: ClassVar[int] = 3
    UINT16: ClassVar[int] = 4
    INT32: ClassVar[int] = 5
    UINT32: ClassVar[int] = 6
    FLOAT32: ClassVar[int] = 7
    FLOAT64: ClassVar[int] = 8
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/PointField"


@dataclass
class sensor_msgs__msg__PointCloud2:  # noqa: N801
    header: std_msgs__msg__Header
    height: int
    width: int
    fields: list[sensor_msgs__msg__PointField]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: npt.NDArray[np.uint8]
    is_dense: bool
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/PointCloud2"


@dataclass
class geometry_msgs__msg__Quaternion:  # noqa: N801
    x: float
    y: float
    z: float
    w: float
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/Quaternion"


@dataclass
class geometry_msgs__msg__Vector3:  # noqa: N801
    x: float
    y: float
    z: float
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/Vector3"


@dataclass
class sensor_msgs__msg__Imu:  # noqa: N801
    header: std_msgs__msg__Header
    orientation: geometry_msgs__msg__Quaternion
    orientation_covariance: npt.NDArray[np.float64]
    angular_velocity: geometry_msgs__msg__Vector3
    angular_velocity_covariance: npt.NDArray[np.float64]
    linear_acceleration: geometry_msgs__msg__Vector3
    linear_acceleration_covariance: npt.NDArray[np.float64]
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/Imu"


@dataclass
class geometry_msgs__msg__Point:  # noqa: N801
    x: float
    y: float
    z: float
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/Point"


@dataclass
class geometry_msgs__msg__Pose:  # noqa: N801
    position: geometry_msgs__msg__Point
    orientation: geometry_msgs__msg__Quaternion
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/Pose"


@dataclass
class geometry_msgs__msg__PoseWithCovariance:  # noqa: N801
    pose: geometry_msgs__msg__Pose
    covariance: npt.NDArray[np.float64]
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/PoseWithCovariance"


@dataclass
class geometry_msgs__msg__PoseWithCovarianceStamped:  # noqa: N801
    header: std_msgs__msg__Header
    pose: geometry_msgs__msg__PoseWithCovariance
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/PoseWithCovarianceStamped"


@dataclass
class geometry_msgs__msg__Twist:  # noqa: N801
    linear: geometry_msgs__msg__Vector3
    angular: geometry_msgs__msg__Vector3
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/Twist"


@dataclass
class geometry_msgs__msg__TwistWithCovariance:  # noqa: N801
    twist: geometry_msgs__msg__Twist
    covariance: npt.NDArray[np.float64]
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/TwistWithCovariance"


@dataclass
class nav_msgs__msg__Odometry:  # noqa: N801
    header: std_msgs__msg__Header
    child_frame_id: str
    pose: geometry_msgs__msg__PoseWithCovariance
    twist: geometry_msgs__msg__TwistWithCovariance
    __msgtype__: ClassVar[str] = "nav_msgs/msg/Odometry"


@dataclass
class sensor_msgs__msg__NavSatStatus:  # noqa: N801
    status: int
    service: int
    STATUS_UNKNOWN: ClassVar[int] = -2
    STATUS_NO_FIX: ClassVar[int] = -1
    STATUS_FIX: ClassVar[int] = 0
    STATUS_SBAS_FIX: ClassVar[int] = 1
    STATUS_GBAS_FIX: ClassVar[int] = 2
    SERVICE_UNKNOWN: ClassVar[int] = 0
    SERVICE_GPS: ClassVar[int] = 1
    SERVICE_GLONASS: ClassVar[int] = 2
    SERVICE_COMPASS: ClassVar[int] = 4
    SERVICE_GALILEO: ClassVar[int] = 8
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/NavSatStatus"


@dataclass
class sensor_msgs__msg__NavSatFix:  # noqa: N801
    header: std_msgs__msg__Header
    status: sensor_msgs__msg__NavSatStatus
    latitude: float
    longitude: float
    altitude: float
    position_covariance: npt.NDArray[np.float64]
    position_covariance_type: int
    COVARIANCE_TYPE_UNKNOWN: ClassVar[int] = 0
    COVARIANCE_TYPE_APPROXIMATED: ClassVar[int] = 1
    COVARIANCE_TYPE_DIAGONAL_KNOWN: ClassVar[int] = 2
    COVARIANCE_TYPE_KNOWN: ClassVar[int] = 3
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/NavSatFix"


@dataclass
class nav_msgs__msg__MapMetaData:  # noqa: N801
    map_load_time: builtin_interfaces__msg__Time
    resolution: float
    width: int
    height: int
    origin: geometry_msgs__msg__Pose
    __msgtype__: ClassVar[str] = "nav_msgs/msg/MapMetaData"


@dataclass
class nav_msgs__msg__OccupancyGrid:  # noqa: N801
    header: std_msgs__msg__Header
    info: nav_msgs__msg__MapMetaData
    data: npt.NDArray[np.int8]
    __msgtype__: ClassVar[str] = "nav_msgs/msg/OccupancyGrid"


@dataclass
class geometry_msgs__msg__Transform:  # noqa: N801
    translation: geometry_msgs__msg__Vector3
    rotation: geometry_msgs__msg__Quaternion
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/Transform"


@dataclass
class geometry_msgs__msg__TransformStamped:  # noqa: N801
    header: std_msgs__msg__Header
    child_frame_id: str
    transform: geometry_msgs__msg__Transform
    __msgtype__: ClassVar[str] = "geometry_msgs/msg/TransformStamped"


@dataclass
class tf2_msgs__msg__TFMessage:  # noqa: N801
    transforms: list[geometry_msgs__msg__TransformStamped]
    __msgtype__: ClassVar[str] = "tf2_msgs/msg/TFMessage"


@dataclass
class diagnostic_msgs__msg__KeyValue:  # noqa: N801
    key: str
    value: str
    __msgtype__: ClassVar[str] = "diagnostic_msgs/msg/KeyValue"


@dataclass
class diagnostic_msgs__msg__DiagnosticStatus:  # noqa: N801
    level: int
    name: str
    message: str
    hardware_id: str
    values: list[diagnostic_msgs__msg__KeyValue]
    OK: ClassVar[int] = 0
    WARN: ClassVar[int] = 1
    ERROR: ClassVar[int] = 2
    STALE: ClassVar[int] = 3
    __msgtype__: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticStatus"


@dataclass
class diagnostic_msgs__msg__DiagnosticArray:  # noqa: N801
    header: std_msgs__msg__Header
    status: list[diagnostic_msgs__msg__DiagnosticStatus]
    __msgtype__: ClassVar[str] = "diagnostic_msgs/msg/DiagnosticArray"


@dataclass
class std_msgs__msg__String:  # noqa: N801
    data: str
    __msgtype__: ClassVar[str] = "std_msgs/msg/String"


@dataclass
class std_msgs__msg__MultiArrayDimension:  # noqa: N801
    label: str
    size: int
    stride: int
    __msgtype__: ClassVar[str] = "std_msgs/msg/MultiArrayDimension"


@dataclass
class std_msgs__msg__MultiArrayLayout:  # noqa: N801
    dim: list[std_msgs__msg__MultiArrayDimension]
    data_offset: int
    __msgtype__: ClassVar[str] = "std_msgs/msg/MultiArrayLayout"


@dataclass
class std_msgs__msg__UInt8MultiArray:  # noqa: N801
    layout: std_msgs__msg__MultiArrayLayout
    data: npt.NDArray[np.uint8]
    __msgtype__: ClassVar[str] = "std_msgs/msg/UInt8MultiArray"


# By message: `type name` or `type NAME=value` a line, as in its .msg file
_DEFINITIONS = {
    "builtin_interfaces/msg/Time": """
        int32 sec
        uint32 nanosec
    """,
    "std_msgs/msg/Header": """
        builtin_interfaces/Time stamp
        string frame_id
    """,
    "sensor_msgs/msg/LaserScan": """
        std_msgs/Header header
        float32 angle_min
        float32 angle_max
        float32 angle_increment
        float32 time_increment
        float32 scan_time
        float32 range_min
        float32 range_max
        float32[] ranges
        float32[] intensities
    """,
    "sensor_msgs/msg/LaserEcho": """
        float32[] echoes
    """,
    "sensor_msgs/msg/MultiEchoLaserScan": """
        std_msgs/Header header
        float32 angle_min
        float32 angle_max
        float32 angle_increment
        float32 time_increment
        float32 scan_time
        float32 range_min
        float32 range_max
        sensor_msgs/LaserEcho[] ranges
        sensor_msgs/LaserEcho[] intensities
    """,
    "sensor_msgs/msg/PointField": """
        uint8 INT8=1
        uint8 UINT8=2
        uint8 INT16=3
        uint8 UINT16=4
        uint8 INT32=5
        uint8 UINT32=6
        uint8 FLOAT32=7
        uint8 FLOAT64=8
        string name
        uint32 offset
        uint8 datatype
        uint32 count
    """,
    "sensor_msgs/msg/PointCloud2": """
        std_msgs/Header header
        uint32 height
        uint32 width
        sensor_msgs/PointField[] fields
        bool is_bigendian
        uint32 point_step
        uint32 row_step
        uint8[] data
        bool is_dense
    """,
    "geometry_msgs/msg/Quaternion": """
        float64 x
        float64 y
        float64 z
        float64 w
    """,
    "geometry_msgs/msg/Vector3": """
        float64 x
        float64 y
        float64 z
    """,
    "sensor_msgs/msg/Imu": """
        std_msgs/Header header
        geometry_msgs/Quaternion orientation
        float64[9] orientation_covariance
        geometry_msgs/Vector3 angular_velocity
        float64[9] angular_velocity_covariance
        geometry_msgs/Vector3 linear_acceleration
        float64[9] linear_acceleration_covariance
    """,
    "geometry_msgs/msg/Point": """
        float64 x
        float64 y
        float64 z
    """,
    "geometry_msgs/msg/Pose": """
        geometry_msgs/Point position
        geometry_msgs/Quaternion orientation
    """,
    "geometry_msgs/msg/PoseWithCovariance": """
        geometry_msgs/Pose pose
        float64[36] covariance
    """,
    "geometry_msgs/msg/PoseWithCovarianceStamped": """
        std_msgs/Header header
        geometry_msgs/PoseWithCovariance pose
    """,
    "geometry_msgs/msg/Twist": """
        geometry_msgs/Vector3 linear
        geometry_msgs/Vector3 angular
    """,
    "geometry_msgs/msg/TwistWithCovariance": """
        geometry_msgs/Twist twist
        float64[36] covariance
    """,
    "nav_msgs/msg/Odometry": """
        std_msgs/Header header
        string child_frame_id
        geometry_msgs/PoseWithCovariance pose
        geometry_msgs/TwistWithCovariance twist
    """,
    "sensor_msgs/msg/NavSatStatus": """
        int8 STATUS_UNKNOWN=-2
        int8 STATUS_NO_FIX=-1
        int8 STATUS_FIX=0
        int8 STATUS_SBAS_FIX=1
        int8 STATUS_GBAS_FIX=2
        uint16 SERVICE_UNKNOWN=0
        uint16 SERVICE_GPS=1
        uint16 SERVICE_GLONASS=2
        uint16 SERVICE_COMPASS=4
        uint16 SERVICE_GALILEO=8
        int8 status
        uint16 service
    """,
    "sensor_msgs/msg/NavSatFix": """
        uint8 COVARIANCE_TYPE_UNKNOWN=0
        uint8 COVARIANCE_TYPE_APPROXIMATED=1
        uint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2
        uint8 COVARIANCE_TYPE_KNOWN=3
        std_msgs/Header header
        sensor_msgs/NavSatStatus status
        float64 latitude
        float64 longitude
        float64 altitude
        float64[9] position_covariance
        uint8 position_covariance_type
    """,
    "nav_msgs/msg/MapMetaData": """
        builtin_interfaces/Time map_load_time
        float32 resolution
        uint32 width
        uint32 height
        geometry_msgs/Pose origin
    """,
    "nav_msgs/msg/OccupancyGrid": """
        std_msgs/Header header
        nav_msgs/MapMetaData info
        int8[] data
    """,
    "geometry_msgs/msg/Transform": """
        geometry_msgs/Vector3 translation
        geometry_msgs/Quaternion rotation
    """,
    "geometry_msgs/msg/TransformStamped": """
        std_msgs/Header header
        string child_frame_id
        geometry_msgs/Transform transform
    """,
    "tf2_msgs/msg/TFMessage": """
        geometry_msgs/TransformStamped[] transforms
    """,
    "diagnostic_msgs/msg/KeyValue": """
        string key
        string value
    """,
    "diagnostic_msgs/msg/DiagnosticStatus": """
        byte OK=0
        byte WARN=1
        byte ERROR=2
        byte STALE=3
        byte level
        string name
        string message
        string hardware_id
        diagnostic_msgs/KeyValue[] values
    """,
    "diagnostic_msgs/msg/DiagnosticArray": """
        std_msgs/Header header
        diagnostic_msgs/DiagnosticStatus[] status
    """,
    "std_msgs/msg/String": """
        string data
    """,
    "std_msgs/msg/MultiArrayDimension": """
        string label
        uint32 size
        uint32 stride
    """,
    "std_msgs/msg/MultiArrayLayout": """
        std_msgs/MultiArrayDimension[] dim
        uint32 data_offset
    """,
    "std_msgs/msg/UInt8MultiArray": """
        std_msgs/MultiArrayLayout layout
        uint8[] data
    """,
    **MARKER_DEFINITIONS,
}


def _kind(text: str) -> tuple[Nodetype, Any]:
    if text.endswith("]"):
        element, _, length = text[:-1].partition("[")
        return (
            (Nodetype.ARRAY, (_kind(element), int(length)))
            if length
            else (Nodetype.SEQUENCE, (_kind(element), 0))
        )
    if "/" in text:
        return Nodetype.NAME, text.replace("/", "/msg/")
    return Nodetype.BASE, (text, 0)


def _fields(definition: str) -> tuple[list[tuple[str, str, int]], list[tuple[str, tuple[Nodetype, Any]]]]:
    constants, fields = [], []
    for line in definition.strip().splitlines():
        kind, name = line.split()
        if "=" in name:
            name, _, value = name.partition("=")
            constants.append((name, kind, int(value)))
        else:
            fields.append((name, _kind(kind)))
    return constants, fields


FIELDDEFS = {name: _fields(definition) for name, definition in _DEFINITIONS.items()}  # the store reads this
