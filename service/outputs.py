"""Outputs of the mapper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2

State = Literal["ok", "degraded", "lost"]
STATES: tuple[State, ...] = get_args(State)

# Why a scan is not `ok`; "": it is. Other programs read these: new ones may come, none changes its meaning.
# docs/mapping.md has a table of them.
ReasonId = Literal[
    "",
    # the scan on the map
    "few_returns",
    "contradicted",
    "off_map",
    "little_on_map",
    "new_ground",
    "few_confirming",
    "little_in_common",
    "unconfirmed",
    "prediction_stands",
    "new_map",
    # how well the pose is known
    "pose_uncertain",
    "open_direction",
    "scene_moves",
    "drift",
    "unmeasured_way",
    # the place in a map
    "not_placed",
    "placed_once",
    "found_once",
    "several_places",
    "pose_refused",
    # sensors
    "odometry_stuck",
    "odometry_contradicts",
    "odometry_turns_opposed",
    "odometry_mounting",
    "imu_contradicts",
    "laser_repeats",
    "laser_covered",
    "laser_contradicts",
    "laser_mounting",
    "laser_stamps",
]

# Why a status of health is not `ok` besides; docs/operations.md has a table of them.
HealthReasonId = Literal[
    # mapping
    "paused",
    "no_scan",
    "no_pose",
    "overloaded",
    "no_loops",
    "graph_behind",
    "mapper_restarted",
    # a sensor
    "link_down",
    "no_frame",
    "frames_stopped",
    "frames_late",
    # clock
    "clock_stepped",
    # outputs
    "output_failed",
    "messages_dropped",
    "certificate_not_valid",
    "recording_stopped",
    "disk_full",
    "disk_error",
    "map_not_saved",
    "not_served",
    "token_unreadable",
    "no_router",
    "name_taken",
]

# The row of the manual that explains each: page#anchor.
REASON_PLACES: Mapping[str, str] = {
    **{reason: f"mapping.md#{reason}" for reason in get_args(ReasonId) if reason},
    **{reason: f"operations.md#{reason}" for reason in get_args(HealthReasonId)},
}


class Reason(str):
    """Why a scan is not `ok`, for people and for programs: a sentence with its figures, and its `id`, which
    stays the same when the words change. False where it is empty.
    """

    __slots__ = ("id",)
    id: ReasonId

    def __new__(cls, id: ReasonId, words: str) -> "Reason":
        reason = super().__new__(cls, words)
        reason.id = id
        return reason

    def __getnewargs__(self) -> tuple[ReasonId, str]:  # type: ignore[override]  # str has no id to pickle
        return self.id, str(self)

    def reworded(self, words: str) -> "Reason":
        """The same reason in other words."""
        return Reason(self.id, words)


NO_REASON = Reason("", "")


def reason_value(reason: HealthReasonId) -> dict[str, str]:
    """As values of a status have it."""
    return {"reason_id": reason}


# Occupancy of a cell as nav_msgs/OccupancyGrid has it; between FREE and OCCUPIED: per cent.
UNKNOWN, FREE, OCCUPIED = -1, 0, 100


@dataclass(frozen=True, slots=True, eq=False)
class TileUpdate:
    """A square of the map that changed. cells[row, column]; cells[0, 0] is its lower left corner, which lies
    at (ix * W * cell_m, iy * W * cell_m) in the map frame. Same key and a higher version replaces it.
    """

    level: int  # 0 is the finest
    ix: int
    iy: int
    version: int  # counts up over the whole map
    cell_m: float
    cells: npt.NDArray[np.int8]  # (W, W), -1 unknown, 0..100 per cent occupied; read-only


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A whole map as one picture: cells[row, column], row 0 lowest. The lower left corner of cells[0, 0]
    lies at (x_min_m, y_min_m) in the map frame; no turn.
    """

    version: int  # of the newest tile in it
    cell_m: float
    x_min_m: float
    y_min_m: float
    cells: npt.NDArray[np.int8]  # (H, W), -1 unknown, 0..100 per cent occupied; read-only


@dataclass(frozen=True, slots=True, eq=False)
class GraphPicture:
    """The pose graph as lines, for people to look at; map frame, m, float32. Thinned where it is long.

    stamp_ns   of the newest key frame
    paths      stretches of key frames, (N, 2) each; from one to the next only loops lead
    accepted   (L, 2, 2) both ends of each loop that holds the graph together
    refused    (R, 2, 2) of each that was measured and is not accepted, see service.mapper.loop_evidence
    borders    outlines of sub-maps, (K, 2) each; none where the method has no sub-maps
    evidence   of some "accepted" and some "refused" loops, as of service.mapper.loop_evidence; empty where
               the method reports none
    """

    stamp_ns: int
    paths: Sequence[npt.NDArray[np.float32]]
    accepted: npt.NDArray[np.float32]
    refused: npt.NDArray[np.float32]
    borders: Sequence[npt.NDArray[np.float32]] = ()
    evidence: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)


_NO_ENDS = np.empty((0, 2, 2), np.float32)
NO_GRAPH = GraphPicture(0, (), _NO_ENDS, _NO_ENDS)  # of a map that has just begun


@dataclass(frozen=True, slots=True, eq=False)
class MapperOutput:
    """The answer to one scan. pose_map_base = pose_map_odom @ pose_odom_base, at the scan's first ray."""

    stamp_ns: int
    pose_odom_base: SE2  # smooth: never jumps
    pose_map_odom: SE2  # jumps when a loop closes
    twist_base: tuple[float, float, float]  # m/s forward, m/s left, rad/s
    covariance: npt.NDArray[np.float64]  # (3, 3) of x, y, theta in the map, base axes; m^2, m rad, rad^2
    state: State
    reason: Reason  # why it is not "ok", else NO_REASON
    inlier_ratio: float  # share of the beams used that agree with the map, 0..1
    geo_reference: GeoReference | None = None  # where the map lies on the earth; None: that is not known
    # of pose_odom_base against the first scan, which no loop makes smaller; None: the same as in the map
    odom_covariance: npt.NDArray[np.float64] | None = None

    @property
    def pose_map_base(self) -> SE2:
        return self.pose_map_odom @ self.pose_odom_base
