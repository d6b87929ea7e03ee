"""Markers: messages in which lines are drawn for RViz and Foxglove; ros_messages.py brings them in."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from service.encoding import ros_messages as ros


@dataclass
class builtin_interfaces__msg__Duration:  # noqa: N801
    sec: int
    nanosec: int
    __msgtype__: ClassVar[str] = "builtin_interfaces/msg/Duration"


@dataclass
class std_msgs__msg__ColorRGBA:  # noqa: N801
    r: float
    g: float
    b: float
    a: float
    __msgtype__: ClassVar[str] = "std_msgs/msg/ColorRGBA"


@dataclass
class sensor_msgs__msg__CompressedImage:  # noqa: N801
    header: "ros.std_msgs__msg__Header"
    format: str
    data: npt.NDArray[np.uint8]
    __msgtype__: ClassVar[str] = "sensor_msgs/msg/CompressedImage"


@dataclass
class visualization_msgs__msg__UVCoordinate:  # noqa: N801
    u: float
    v: float
    __msgtype__: ClassVar[str] = "visualization_msgs/msg/UVCoordinate"


@dataclass
class visualization_msgs__msg__MeshFile:  # noqa: N801
    filename: str
    data: npt.NDArray[np.uint8]
    __msgtype__: ClassVar[str] = "visualization_msgs/msg/MeshFile"


@dataclass
class visualization_msgs__msg__Marker:  # noqa: N801
    header: "ros.std_msgs__msg__Header"
    ns: str
    id: int
    type: int
    action: int
    pose: "ros.geometry_msgs__msg__Pose"
    scale: "ros.geometry_msgs__msg__Vector3"
    color: std_msgs__msg__ColorRGBA
    lifetime: builtin_interfaces__msg__Duration
    frame_locked: bool
    points: "list[ros.geometry_msgs__msg__Point]"
    colors: list[std_msgs__msg__ColorRGBA]
    texture_resource: str
    texture: sensor_msgs__msg__CompressedImage
    uv_coordinates: list[visualization_msgs__msg__UVCoordinate]
    text: str
    mesh_resource: str
    mesh_file: visualization_msgs__msg__MeshFile
    mesh_use_embedded_materials: bool
    ARROW: ClassVar[int] = 0
    CUBE: ClassVar[int] = 1
    SPHERE: ClassVar[int] = 2
    CYLINDER: ClassVar[int] = 3
    LINE_STRIP: ClassVar[int] = 4
    LINE_LIST: ClassVar[int] = 5
    CUBE_LIST: ClassVar[int] = 6
    SPHERE_LIST: ClassVar[int] = 7
    POINTS: ClassVar[int] = 8
    TEXT_VIEW_FACING: ClassVar[int] = 9
    MESH_RESOURCE: ClassVar[int] = 10
    TRIANGLE_LIST: ClassVar[int] = 11
    ARROW_STRIP: ClassVar[int] = 12
    ADD: ClassVar[int] = 0
    MODIFY: ClassVar[int] = 0
    DELETE: ClassVar[int] = 2
    DELETEALL: ClassVar[int] = 3
    __msgtype__: ClassVar[str] = "visualization_msgs/msg/Marker"


@dataclass
class visualization_msgs__msg__MarkerArray:  # noqa: N801
    markers: list[visualization_msgs__msg__Marker]
    __msgtype__: ClassVar[str] = "visualization_msgs/msg/MarkerArray"


DEFINITIONS = {
    "builtin_interfaces/msg/Duration": """
        int32 sec
        uint32 nanosec
    """,
    "std_msgs/msg/ColorRGBA": """
        float32 r
        float32 g
        float32 b
        float32 a
    """,
    "sensor_msgs/msg/CompressedImage": """
        std_msgs/Header header
        string format
        uint8[] data
    """,
    "visualization_msgs/msg/UVCoordinate": """
        float32 u
        float32 v
    """,
    "visualization_msgs/msg/MeshFile": """
        string filename
        uint8[] data
    """,
    "visualization_msgs/msg/Marker": """
        int32 ARROW=0
        int32 CUBE=1
        int32 SPHERE=2
        int32 CYLINDER=3
        int32 LINE_STRIP=4
        int32 LINE_LIST=5
        int32 CUBE_LIST=6
        int32 SPHERE_LIST=7
        int32 POINTS=8
        int32 TEXT_VIEW_FACING=9
        int32 MESH_RESOURCE=10
        int32 TRIANGLE_LIST=11
        int32 ARROW_STRIP=12
        int32 ADD=0
        int32 MODIFY=0
        int32 DELETE=2
        int32 DELETEALL=3
        std_msgs/Header header
        string ns
        int32 id
        int32 type
        int32 action
        geometry_msgs/Pose pose
        geometry_msgs/Vector3 scale
        std_msgs/ColorRGBA color
        builtin_interfaces/Duration lifetime
        bool frame_locked
        geometry_msgs/Point[] points
        std_msgs/ColorRGBA[] colors
        string texture_resource
        sensor_msgs/CompressedImage texture
        visualization_msgs/UVCoordinate[] uv_coordinates
        string text
        string mesh_resource
        visualization_msgs/MeshFile mesh_file
        bool mesh_use_embedded_materials
    """,
    "visualization_msgs/msg/MarkerArray": """
        visualization_msgs/Marker[] markers
    """,
}
