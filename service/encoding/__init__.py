"""Frames and outputs <-> ROS 2 CDR: the one wire format, for Zenoh and for recordings alike.

A frame that is mapped has been through here: the live mapper eats what `decode_frame` makes of the message
that `encode_frame` made, and a replay decodes the recorded payload. Both get the same frame bit for bit;
rounding to the wire's float32 happens once, in the encoding.

Importers take all from here: what is imported below is exported (pyproject.toml tells ruff and mypy so).
"""

from collections.abc import Callable

import numpy as np

from drivers.frames import NO_INTENSITY, GnssFix, ImuSample, LaserScan
from drivers.link import RawChunk
from service.encoding.frames import (
    NO_COVARIANCE,
    NO_ROTATION,
    decode_frame,
    decode_raw,
    encode_frame,
    encode_raw,
    frame_id,
    odometry_fault,
    scan_fault,
    scan_of_fields,
    span_fault,
    turned_over,
)
from service.encoding.graph import GRAPH, decode_graph, encode_graph
from service.encoding.outputs import (
    CHANGES,
    ERROR,
    LEVEL_OF_STATE,
    OK,
    STALE,
    STANDING,
    TILES,
    WARNING,
    Pose,
    Status,
    Transform,
    decode_diagnostics,
    decode_event,
    decode_grid,
    decode_initial_pose,
    decode_mountings,
    decode_pose,
    decode_transforms,
    decode_upside_down,
    encode_diagnostics,
    encode_event,
    encode_grid,
    encode_odom,
    encode_pose,
    encode_tf,
    encode_tf_static,
    encode_tile,
    tile_channel,
)
from service.encoding.steps import APPLY_RESULT, decode_step
from service.encoding.wire import (
    BASE_FRAME,
    BYTES,
    DIAGNOSTICS,
    IMU,
    LASER_SCAN,
    MAP_FRAME,
    MARKERS,
    MULTI_ECHO_SCAN,
    NAV_SAT_FIX,
    OCCUPANCY_GRID,
    ODOM_FRAME,
    ODOMETRY,
    POINT_CLOUD,
    STRING,
    TF,
    LogClock,
    Message,
    from_ros1,
    pose_on_wire,
    read,
    schema_text,
    type_hash,
)
from service.geometry.se2 import SE2
from service.outputs import NO_REASON, GraphPicture, Grid, MapperOutput

_OUTPUT = MapperOutput(1, SE2(), SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0)
_LINE = np.zeros((2, 2), np.float32)
_ONE_OF_EACH: tuple[Callable[[], Message], ...] = (
    lambda: encode_frame(
        LaserScan("s", 1, 1, 1, 1, 0.0, 0.1, 0.0, 1.0, np.ones(2, np.float32), NO_INTENSITY)
    ),
    lambda: encode_frame(ImuSample("s", 1, 1, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))),
    lambda: encode_frame(GnssFix("s", 1, 1, 0, 0.0, 0.0, 0.0, (0.0,) * 9)),
    lambda: encode_pose(_OUTPUT, 1),
    lambda: encode_tf(_OUTPUT, 1),
    lambda: encode_grid(Grid(0, 0.05, 0.0, 0.0, np.zeros((1, 1), np.int8)), 1, 1),
    lambda: encode_graph(GraphPicture(1, [_LINE], _LINE[None], _LINE[None]), 1),
    lambda: encode_diagnostics("health", [Status("s", 0, "", {"k": "v"})], 1, 1),
    lambda: encode_event("", 1, 1),
    lambda: encode_raw("s", RawChunk(1, "received"), 0),
)


def warm_up() -> None:
    """Generate the code of every message type, about 10 ms each, so that no scan has to wait for it."""
    for encode in _ONE_OF_EACH:
        message = encode()
        read(message.type, message.payload)
