"""What the mapper and the service put out -> ROS messages, and back where a file is read."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from service.encoding import quick, wire
from service.encoding import ros_messages as ros
from service.encoding.wire import FloatArray, Message
from service.errors import InputError
from service.geometry.se2 import SE2
from service.outputs import Grid, MapperOutput, State, TileUpdate

ANY_HEADING = math.pi**2 / 3.0  # rad^2, variance of a heading of which nothing is known


OK, WARNING, ERROR, STALE = 0, 1, 2, 3  # levels of diagnostic_msgs/DiagnosticStatus
LEVEL_OF_STATE: Mapping[State, int] = {"ok": OK, "degraded": WARNING, "lost": ERROR}
TILES = "map/tile"  # begin of the channels of tiles
CHANGES = "map/changes"  # the channel: what is not as a stored map says, see service.mapper.map_changes
STANDING = "standing"  # the channel: for how long things stand, see service.mapper.maps.occupancy
# Viewers in 3D draw what lies at one height in any order: the map would hide scans and path. So it lies below
# them, and what is shown on it halfway. More than a viewer's depth resolves (mm), less than a cell.
MAP_BELOW_M = 0.02


class Status(NamedTuple):
    """One line of a DiagnosticArray."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A decoded nav_msgs/Odometry as pose_<frame>_<child>."""

    stamp_ns: int
    frame: str
    child: str
    pose: SE2
    covariance: FloatArray  # (3, 3) of x, y, theta in the child's axes; m^2, m rad, rad^2
    twist: tuple[float, float, float]  # child's axes: m/s forward, m/s left, rad/s


@dataclass(frozen=True, slots=True)
class Transform:
    """One edge of a TFMessage: takes coordinates of child to frame."""

    stamp_ns: int
    frame: str
    child: str
    translation_m: tuple[float, float, float]
    rotation_wxyz: tuple[float, float, float, float]

    @property
    def is_planar(self) -> bool:
        return any(self.rotation_wxyz) and not any(self.rotation_wxyz[1:3])

    @property
    def is_upside_down(self) -> bool:
        """Planar, but for half a turn about the child's forward axis."""
        w, x, y, z = self.rotation_wxyz
        return any((x, y)) and not any((w, z))

    @property
    def pose(self) -> SE2:
        """pose_frame_child in the plane; what a planar pose becomes on the wire."""
        w, x, y, z = self.rotation_wxyz
        heading_rad = wire.yaw(ros.geometry_msgs__msg__Quaternion(x, y, z, w))
        return SE2(self.translation_m[0], self.translation_m[1], heading_rad)


def encode_pose(output: MapperOutput, log_ns: int) -> Message:
    """Base in map, as channel "pose"."""
    payload = _pose_payload(output, wire.MAP_FRAME, output.pose_map_base, output.covariance)
    return Message("pose", wire.ODOMETRY, output.stamp_ns, log_ns, payload)


def encode_odom(output: MapperOutput, log_ns: int) -> Message:
    """Base in odom, which never jumps, as channel "odom"."""
    covariance = output.covariance if output.odom_covariance is None else output.odom_covariance
    payload = _pose_payload(output, wire.ODOM_FRAME, output.pose_odom_base, covariance)
    return Message("odom", wire.ODOMETRY, output.stamp_ns, log_ns, payload)


def encode_tf(output: MapperOutput, log_ns: int) -> Message:
    """map -> odom and odom -> base_link at the scan's first ray, as channel "tf"."""
    edges = (
        (wire.MAP_FRAME, wire.ODOM_FRAME, output.pose_map_odom),
        (wire.ODOM_FRAME, wire.BASE_FRAME, output.pose_odom_base),
    )
    return Message("tf", wire.TF, output.stamp_ns, log_ns, quick.transforms(output.stamp_ns, edges))


def encode_tf_static(
    poses_base_sensor: Mapping[str, SE2],
    stamp_ns: int,
    log_ns: int,
    height_m: Mapping[str, float] | None = None,
    upside_down: Collection[str] = (),
) -> Message:
    """base_link -> each sensor, as channel "tf_static"; heights in m, 0 where none is given."""
    transforms = [
        _transform_ros(stamp_ns, wire.BASE_FRAME, sensor, pose) for sensor, pose in poses_base_sensor.items()
    ]
    for transform in transforms:
        sensor = transform.child_frame_id
        transform.transform.translation.z = (height_m or {}).get(sensor, 0.0)
        if sensor in upside_down:
            q = transform.transform.rotation
            q.w, q.x, q.y, q.z = 0.0, q.w, q.z, 0.0  # half a turn about x, then the yaw
    return wire.to_message("tf_static", wire.TF, stamp_ns, log_ns, ros.tf2_msgs__msg__TFMessage(transforms))


def tile_channel(tile: TileUpdate) -> str:
    """Channel of a tile: "map/tile/<level>/<ix>/<iy>"."""
    return f"{TILES}/{tile.level}/{tile.ix}/{tile.iy}"


def encode_tile(tile: TileUpdate, stamp_ns: int, log_ns: int) -> Message:
    """A tile as a grid of its own, as the tile's channel."""
    edge_m = tile.cells.shape[0] * tile.cell_m
    grid = Grid(tile.version, tile.cell_m, tile.ix * edge_m, tile.iy * edge_m, tile.cells)
    return encode_grid(grid, stamp_ns, log_ns, tile_channel(tile))


def encode_grid(grid: Grid, stamp_ns: int, log_ns: int, channel: str = "map") -> Message:
    """A grid in the map frame. The message has no field for its version."""
    height, width = grid.cells.shape
    origin = wire.planar_pose_ros(SE2(grid.x_min_m, grid.y_min_m, 0.0))
    origin.position.z = -MAP_BELOW_M / 2 if channel in (CHANGES, STANDING) else -MAP_BELOW_M
    info = ros.nav_msgs__msg__MapMetaData(
        map_load_time=wire.time_ros(stamp_ns),
        resolution=grid.cell_m,
        width=width,
        height=height,
        origin=origin,
    )
    cells = np.ascontiguousarray(grid.cells, dtype=np.int8).ravel()
    payload = ros.nav_msgs__msg__OccupancyGrid(wire.header_ros(stamp_ns, wire.MAP_FRAME), info, cells)
    return wire.to_message(channel, wire.OCCUPANCY_GRID, stamp_ns, log_ns, payload)


def encode_diagnostics(channel: str, statuses: Sequence[Status], stamp_ns: int, log_ns: int) -> Message:
    """Statuses as channel "diagnostics", "health" or "map/meta"."""
    payload = ros.diagnostic_msgs__msg__DiagnosticArray(
        wire.header_ros(stamp_ns, ""),
        [
            ros.diagnostic_msgs__msg__DiagnosticStatus(
                level=status.level,
                name=status.name,
                message=status.message,
                hardware_id="",
                values=[ros.diagnostic_msgs__msg__KeyValue(k, v) for k, v in status.values.items()],
            )
            for status in statuses
        ],
    )
    return wire.to_message(channel, wire.DIAGNOSTICS, stamp_ns, log_ns, payload)


def encode_event(text: str, stamp_ns: int, log_ns: int) -> Message:
    """Something that happened, JSON text by custom, as channel "events"."""
    return wire.to_message("events", wire.STRING, stamp_ns, log_ns, ros.std_msgs__msg__String(text))


def decode_pose(payload: bytes) -> Pose:
    """A nav_msgs/Odometry message. Raises InputError."""
    m = cast(ros.nav_msgs__msg__Odometry, wire.read(wire.ODOMETRY, payload))
    pose = wire.planar_pose(m.pose.pose)
    turn = wire.rotation_3x3(-pose.theta_rad)
    linear, angular = m.twist.twist.linear, m.twist.twist.angular
    with np.errstate(invalid="ignore", over="ignore"):  # foreign ones may be infinite
        covariance = turn @ m.pose.covariance[wire.PLANAR_CELLS].reshape(3, 3) @ turn.T
    return Pose(
        stamp_ns=wire.stamp_ns_of(m.header.stamp),
        frame=m.header.frame_id,
        child=m.child_frame_id,
        pose=pose,
        covariance=covariance,
        twist=(linear.x, linear.y, angular.z),
    )


def decode_initial_pose(payload: bytes) -> tuple[str, SE2]:
    """Frame and pose of a geometry_msgs/PoseWithCovarianceStamped message. Raises InputError."""
    m = cast(ros.geometry_msgs__msg__PoseWithCovarianceStamped, wire.read(wire.INITIAL_POSE, payload))
    return m.header.frame_id, wire.planar_pose(m.pose.pose)


def decode_grid(payload: bytes) -> Grid:
    """A nav_msgs/OccupancyGrid message whose rows lie along the map's x axis; its version, not being in the
    message, is 0. Raises InputError.
    """
    m = cast(ros.nav_msgs__msg__OccupancyGrid, wire.read(wire.OCCUPANCY_GRID, payload))
    width, height, origin = m.info.width, m.info.height, m.info.origin
    if m.data.size != width * height:
        raise InputError(f"OccupancyGrid of {width} x {height} cells has {m.data.size} values")
    heading_rad = wire.yaw(origin.orientation)
    if abs(heading_rad) > 1e-6:
        raise InputError(f"OccupancyGrid is turned by {heading_rad:.6f} rad; only unturned maps are read")
    return Grid(
        version=0,
        cell_m=round(m.info.resolution, 6),  # float32 on the wire: 0.05 arrives as 0.0500000007
        x_min_m=origin.position.x,
        y_min_m=origin.position.y,
        cells=m.data.reshape(height, width),
    )


def decode_diagnostics(payload: bytes) -> list[Status]:
    """A DiagnosticArray message. Raises InputError."""
    m = cast(ros.diagnostic_msgs__msg__DiagnosticArray, wire.read(wire.DIAGNOSTICS, payload))
    return [Status(s.name, s.level, s.message, {v.key: v.value for v in s.values}) for s in m.status]


def decode_transforms(payload: bytes) -> list[Transform]:
    """A TFMessage. Raises InputError."""
    m = cast(ros.tf2_msgs__msg__TFMessage, wire.read(wire.TF, payload))
    transforms = []
    for edge in m.transforms:
        t, r = edge.transform.translation, edge.transform.rotation
        transforms.append(
            Transform(
                stamp_ns=wire.stamp_ns_of(edge.header.stamp),
                frame=edge.header.frame_id.lstrip("/"),  # tf 1 wrote "/base_link"
                child=edge.child_frame_id.lstrip("/"),
                translation_m=(t.x, t.y, t.z),
                rotation_wxyz=(r.w, r.x, r.y, r.z),
            )
        )
    return transforms


def decode_mountings(payload: bytes) -> dict[str, SE2]:
    """Sensor -> pose_base_sensor of what `encode_tf_static` made. Raises InputError.

    The live mapper takes its mountings from here too, so that the replay has them to the last bit.
    """
    return {t.child: t.pose for t in decode_transforms(payload) if t.frame == wire.BASE_FRAME}


def decode_upside_down(payload: bytes) -> frozenset[str]:
    """Sensors that are upside down by `encode_tf_static`. Raises InputError."""
    edges = decode_transforms(payload)
    return frozenset(t.child for t in edges if t.frame == wire.BASE_FRAME and t.is_upside_down)


def decode_event(payload: bytes) -> str:
    """A std_msgs/String message. Raises InputError."""
    return str(cast(ros.std_msgs__msg__String, wire.read(wire.STRING, payload)).data)


def _pose_payload(output: MapperOutput, frame: str, pose: SE2, covariance: FloatArray) -> bytes:
    """covariance: (3, 3) in base axes; Odometry wants it in the axes of `frame`."""
    turn = wire.rotation_3x3(pose.theta_rad)
    bounded = _bounded(turn @ covariance @ turn.T)
    return wire.odometry_payload(output.stamp_ns, frame, pose, bounded.ravel(), output.twist_base)


def _bounded(covariance: FloatArray) -> FloatArray:
    """(3, 3) of x, y, theta. What is not known gets the variance NOT_KNOWN, and no correlation: a heading
    that may as well be any, a direction of the plane in which the position is worse than that.
    """
    if not np.isfinite(covariance).all():
        return wire.NOT_KNOWN * np.eye(3)
    bounded = covariance.copy()
    is_heading_known = covariance[2, 2] < ANY_HEADING
    is_place_known = covariance[0, 0] + covariance[1, 1] < wire.NOT_KNOWN
    if not is_heading_known:
        bounded[2, 2] = wire.NOT_KNOWN
    if not is_place_known:
        variances, axes = np.linalg.eigh(covariance[:2, :2])
        bounded[:2, :2] = axes * np.minimum(variances, wire.NOT_KNOWN) @ axes.T
    if not (is_heading_known and is_place_known):
        bounded[2, :2] = bounded[:2, 2] = 0.0
    return bounded


def _transform_ros(
    stamp_ns: int, frame: str, child: str, pose: SE2
) -> ros.geometry_msgs__msg__TransformStamped:
    return ros.geometry_msgs__msg__TransformStamped(
        wire.header_ros(stamp_ns, frame),
        child,
        ros.geometry_msgs__msg__Transform(
            ros.geometry_msgs__msg__Vector3(pose.x_m, pose.y_m, 0.0), wire.quaternion_ros(pose.theta_rad)
        ),
    )
