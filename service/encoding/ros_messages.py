"""The ROS 2 messages that go over the wire, as rosbags' type store wants them.

rosbags brings all messages of ROS 2 Jazzy, and of each release before it, as classes made at import: 0.2 s of
every start. These are those that are used, with the names and fields that they have there.
"""

from dataclasses import make_dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from rosbags.interfaces import Nodetype

if TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """A class a message, made below: `std_msgs__msg__Header` of std_msgs/msg/Header, as in rosbags."""


# By message, as in its .msg file: the fields and constants of a type with commas, types with semicolons
_DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec; uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp; string frame_id",
    "sensor_msgs/LaserScan": (
        "std_msgs/Header header; float32 angle_min, angle_max, angle_increment, time_increment, scan_time, "
        "range_min, range_max; float32[] ranges, intensities"
    ),
    "sensor_msgs/LaserEcho": "float32[] echoes",
    "sensor_msgs/MultiEchoLaserScan": (
        "std_msgs/Header header; float32 angle_min, angle_max, angle_increment, time_increment, scan_time, "
        "range_min, range_max; sensor_msgs/LaserEcho[] ranges, intensities"
    ),
    "sensor_msgs/PointField": (
        "uint8 INT8=1, UINT8=2, INT16=3, UINT16=4, INT32=5, UINT32=6, FLOAT32=7, FLOAT64=8; string name; "
        "uint32 offset; uint8 datatype; uint32 count"
    ),
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header; uint32 height, width; sensor_msgs/PointField[] fields; bool is_bigendian; "
        "uint32 point_step, row_step; uint8[] data; bool is_dense"
    ),
    "geometry_msgs/Quaternion": "float64 x, y, z, w",
    "geometry_msgs/Vector3": "float64 x, y, z",
    "sensor_msgs/Imu": (
        "std_msgs/Header header; geometry_msgs/Quaternion orientation; float64[9] orientation_covariance; "
        "geometry_msgs/Vector3 angular_velocity; float64[9] angular_velocity_covariance; "
        "geometry_msgs/Vector3 linear_acceleration; float64[9] linear_acceleration_covariance"
    ),
    "geometry_msgs/Point": "float64 x, y, z",
    "geometry_msgs/Pose": "geometry_msgs/Point position; geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose; float64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": (
        "std_msgs/Header header; geometry_msgs/PoseWithCovariance pose"
    ),
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear, angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist; float64[36] covariance",
    "nav_msgs/Odometry": (
        "std_msgs/Header header; string child_frame_id; geometry_msgs/PoseWithCovariance pose; "
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "sensor_msgs/NavSatStatus": (
        "int8 STATUS_UNKNOWN=-2, STATUS_NO_FIX=-1, STATUS_FIX=0, STATUS_SBAS_FIX=1, STATUS_GBAS_FIX=2; "
        "uint16 SERVICE_UNKNOWN=0, SERVICE_GPS=1, SERVICE_GLONASS=2, SERVICE_COMPASS=4, SERVICE_GALILEO=8; "
        "int8 status; uint16 service"
    ),
    "sensor_msgs/NavSatFix": (
        "uint8 COVARIANCE_TYPE_UNKNOWN=0, COVARIANCE_TYPE_APPROXIMATED=1, COVARIANCE_TYPE_DIAGONAL_KNOWN=2, "
        "COVARIANCE_TYPE_KNOWN=3; std_msgs/Header header; sensor_msgs/NavSatStatus status; float64 "
        "latitude, longitude, altitude; float64[9] position_covariance; uint8 position_covariance_type"
    ),
    "nav_msgs/MapMetaData": (
        "builtin_interfaces/Time map_load_time; float32 resolution; uint32 width, height; "
        "geometry_msgs/Pose origin"
    ),
    "nav_msgs/OccupancyGrid": "std_msgs/Header header; nav_msgs/MapMetaData info; int8[] data",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation; geometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header; string child_frame_id; geometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "diagnostic_msgs/KeyValue": "string key, value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0, WARN=1, ERROR=2, STALE=3; byte level; string name, message, hardware_id; "
        "diagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header; diagnostic_msgs/DiagnosticStatus[] status",
    "std_msgs/String": "string data",
    "std_msgs/MultiArrayDimension": "string label; uint32 size, stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim; uint32 data_offset",
    "std_msgs/UInt8MultiArray": "std_msgs/MultiArrayLayout layout; uint8[] data",
    "builtin_interfaces/Duration": "int32 sec; uint32 nanosec",
    "std_msgs/ColorRGBA": "float32 r, g, b, a",
    "sensor_msgs/CompressedImage": "std_msgs/Header header; string format; uint8[] data",
    "visualization_msgs/UVCoordinate": "float32 u, v",
    "visualization_msgs/MeshFile": "string filename; uint8[] data",
    "visualization_msgs/Marker": (
        "int32 ARROW=0, CUBE=1, SPHERE=2, CYLINDER=3, LINE_STRIP=4, LINE_LIST=5, CUBE_LIST=6, "
        "SPHERE_LIST=7, POINTS=8, TEXT_VIEW_FACING=9, MESH_RESOURCE=10, TRIANGLE_LIST=11, ARROW_STRIP=12, "
        "ADD=0, MODIFY=0, DELETE=2, DELETEALL=3; std_msgs/Header header; string ns; int32 id, type, action; "
        "geometry_msgs/Pose pose; geometry_msgs/Vector3 scale; std_msgs/ColorRGBA color; "
        "builtin_interfaces/Duration lifetime; bool frame_locked; geometry_msgs/Point[] points; "
        "std_msgs/ColorRGBA[] colors; string texture_resource; sensor_msgs/CompressedImage texture; "
        "visualization_msgs/UVCoordinate[] uv_coordinates; string text, mesh_resource; "
        "visualization_msgs/MeshFile mesh_file; bool mesh_use_embedded_materials"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers",
}

_FieldType = tuple[Nodetype, Any]
Members = tuple[list[tuple[str, str, int]], list[tuple[str, _FieldType]]]


def _type(text: str) -> _FieldType:
    if text.endswith("]"):
        element, _, length = text[:-1].partition("[")
        return (Nodetype.ARRAY if length else Nodetype.SEQUENCE), (_type(element), int(length or 0))
    if "/" in text:
        return Nodetype.NAME, text.replace("/", "/msg/")
    return Nodetype.BASE, (text, 0)


def members_of(definition: str) -> Members:
    """Constants (name, type, value) and fields (name, type) of a definition as in the table."""
    constants, fields = [], []
    for members in filter(None, definition.split("; ")):
        type_name, names = members.split(" ", 1)
        for name, is_constant, value in (member.partition("=") for member in names.split(", ")):
            if is_constant:
                constants.append((name, type_name, int(value)))
            else:
                fields.append((name, _type(type_name)))
    return constants, fields


FIELDDEFS = {name.replace("/", "/msg/"): members_of(text) for name, text in _DEFINITIONS.items()}

for _name, (_constants, _fields) in FIELDDEFS.items():
    _class_name = _name.replace("/", "__")
    _class_variables = *((name, value) for name, _, value in _constants), ("__msgtype__", _name)
    globals()[_class_name] = make_dataclass(
        _class_name,
        [(name, Any) for name, _ in _fields] + [(name, ClassVar[Any]) for name, _ in _class_variables],
        namespace={"__module__": __name__, **dict(_class_variables)},
    )
