"""Key frames, as the back end keeps them, and the settings of the graph."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.kernels.loops import thin_points
from service.mapper.by_hand import ByHand
from service.mapper.components import Correction
from service.mapper.saved_graph import SESSION_APART_M, SavedGraph
from service.mapper.walls import walls_of

NO_POINTS, NO_NORMALS = np.empty((0, 2), np.float32), np.empty((0, 3), np.float32)


class LoopsConfig(Section):
    """Spacing of key frames, drift of odometry, and path lengths for loop search."""

    keyframe_distance_m: float = Field(default=0.3, gt=0.0)
    keyframe_turn_rad: float = Field(default=0.15, gt=0.0)
    thin_m: float = Field(default=0.04, ge=0.0)  # least distance between two points of a key frame
    keep_passes: int = Field(default=6, ge=1)  # newest passes kept of a place, besides the first

    search_every_m: float = Field(default=2.0, gt=0.0)
    solve_at_m: float = Field(default=0.05, gt=0.0)  # residual of a loop that triggers a solution
    solve_at_rad: float = Field(default=0.01, gt=0.0)
    place_m: float = Field(default=5.0, gt=0.0)  # path length of a query, and of a sub-map to each side
    apart_m: float = Field(default=12.0, gt=0.0)  # least path length between two passes of a place
    consensus_span_m: float = Field(default=5.0, gt=0.0)  # path length over which loops must agree

    drift: float = Field(default=0.01, ge=0.0)  # m per m of path through the graph
    drift_radpm: float = Field(default=0.0015, ge=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class KeyFrame:
    """A scan selected as a key frame, as sent to the back end."""

    stamp_ns: int
    pose_odom_base: SE2
    covariance: Floats  # (3, 3) of the pose against the local map, base axes
    segment: int  # number of its map segment
    score: float  # inlier ratio on the local map
    is_lost: bool  # the pose is a prediction
    xy_base: npt.NDArray[np.float32]  # (N, 2) m, in beam order
    sensor_xy_m: tuple[float, float]  # base frame
    angle_step_rad: float
    range_sigma_m: float = 0.01
    gap_s: float = math.inf  # longest scan gap since the key frame before
    motion_covariance: Floats | None = None  # (3, 3) against the first scan, base axes; None: not known
    is_unmeasured: bool = False  # motion since the newest known place was not measured


@dataclass(frozen=True, slots=True, eq=False)
class ThinnedScan:
    """Points of a key frame, thinned."""

    xy_base: npt.NDArray[np.float32]  # (N, 2) m
    normals: npt.NDArray[np.float32]  # (N, 3) by estimate_normals
    sensor_xy_m: tuple[float, float]


# Arrays that a SavedGraph has as well.
STORED = ("odom", "map", "path_length_m", "covariance", "score", "gap_s", "is_lost", "range_sigma_m")
ROW = np.dtype(  # of a key frame
    [
        ("odom", np.float64, 3),
        ("map", np.float64, 3),
        ("path_length_m", np.float64),
        ("score", np.float64),
        ("is_lost", np.bool_),
        ("has_points", np.bool_),
        ("segment", np.int64),
        ("gap_s", np.float64),
        ("range_sigma_m", np.float64),
        ("covariance", np.float64, (3, 3)),
        ("motion_covariance", np.float64, (3, 3)),
    ],
    align=True,
)


def thinned(frame: KeyFrame, cell_m: float) -> ThinnedScan:
    """One point per cell."""
    xy, normals = walls_of(
        frame.xy_base.astype(np.float64), frame.sensor_xy_m, frame.angle_step_rad, frame.range_sigma_m
    )
    kept = np.empty(len(xy), np.bool_)
    thin_points(xy, cell_m, kept)
    return ThinnedScan(xy[kept].astype(np.float32), normals[kept].astype(np.float32), frame.sensor_xy_m)


class KeyframeList:
    """All key frames in the order driven. Rows of the arrays are key frames.

    Those of a stored map come first; their segments have the numbers -1, -2 ...
    """

    def __init__(self, stored: SavedGraph | None = None) -> None:
        self.count = self.stored = 0
        self._rows = np.zeros(1, ROW)  # grows by doubling
        self.unmeasured: set[int] = set()  # segments to which the motion was not measured
        self.stamps_ns: list[int] = []
        self.thinned: list[ThinnedScan] = []
        self.by_hand = ByHand() if stored is None else stored.by_hand
        if stored is not None:
            self._restore(stored)

    def _restore(self, stored: SavedGraph) -> None:
        self.count = self.stored = len(stored)
        self._rows = np.zeros(self.count, ROW)
        for name in STORED:
            self._rows[name] = getattr(stored, name)
        self._rows["has_points"] = stored.point_count > 0
        self._rows["segment"] = -1 - np.unique(stored.segment, return_inverse=True)[1]
        self._rows["motion_covariance"] = np.nan
        self.stamps_ns = stored.stamp_ns.tolist()
        ends = [0, *np.cumsum(stored.point_count).tolist()]
        self.thinned = [
            ThinnedScan(stored.xy_base[begin:end], stored.normals[begin:end], (x_m, y_m))
            for (begin, end), (x_m, y_m) in zip(pairwise(ends), stored.sensor_xy_m.tolist(), strict=True)
        ]

    @property
    def odom(self) -> Floats:
        """(N, 3) pose_odom_base."""
        return self._rows["odom"][: self.count]

    @property
    def map(self) -> Floats:
        """(N, 3) pose_map_base; written by the optimiser."""
        return self._rows["map"][: self.count]

    @property
    def path_length_m(self) -> Floats:
        """(N,) path length up to each, m."""
        return self._rows["path_length_m"][: self.count]

    @property
    def score(self) -> Floats:
        """(N,) inlier ratio of each on the local map."""
        return self._rows["score"][: self.count]

    @property
    def is_lost(self) -> npt.NDArray[np.bool_]:
        """(N,) whether its pose in odom is a prediction."""
        return self._rows["is_lost"][: self.count]

    @property
    def has_points(self) -> npt.NDArray[np.bool_]:
        """(N,) whether its points are kept."""
        return self._rows["has_points"][: self.count]

    @property
    def segment(self) -> npt.NDArray[np.int64]:
        """(N,) number of its map segment."""
        return self._rows["segment"][: self.count]

    @property
    def gap_s(self) -> Floats:
        """(N,) longest scan gap since the key frame before, s."""
        return self._rows["gap_s"][: self.count]

    @property
    def range_sigma_m(self) -> Floats:
        """(N,) noise of its ranges, m."""
        return self._rows["range_sigma_m"][: self.count]

    @property
    def is_usable(self) -> npt.NDArray[np.bool_]:
        """(N,) whether it can be aligned with: matched, with points."""
        return self.has_points & ~self.is_lost

    @property
    def covariance(self) -> Floats:
        """(N, 3, 3) covariance of its match."""
        return self._rows["covariance"][: self.count]

    @property
    def motion_covariance(self) -> Floats:
        """(N, 3, 3) covariance of its pose against the first scan of its session; NaN if not known."""
        return self._rows["motion_covariance"][: self.count]

    def place_of(self, frame: KeyFrame) -> Floats:
        """(3,) pose of a new key frame in the map, by odometry since the newest one of its segment; if it
        begins a segment, since the newest one.
        """
        odom = np.array(frame.pose_odom_base)
        if self.count == self.stored:
            return odom
        same = np.flatnonzero(self.segment[self.stored :] == frame.segment)
        before = self.stored + int(same[-1]) if len(same) else self.count - 1
        return se2.compose(self.map[before], se2.between(self.odom[before], odom))

    def append(self, frame: KeyFrame, pose_map: Floats, thinned: ThinnedScan) -> None:
        if self.count == len(self._rows):
            self._rows = np.concatenate((self._rows, np.zeros_like(self._rows)))
        pose, path_length_m = frame.pose_odom_base, 0.0
        if self.count:
            x_m, y_m, _ = self.odom[-1]
            is_first = self.count == self.stored
            step_m = SESSION_APART_M if is_first else np.hypot(pose.x_m - x_m, pose.y_m - y_m)
            path_length_m = self.path_length_m[-1] + step_m
        known = frame.motion_covariance
        self._rows[self.count] = (
            pose,
            pose_map,
            path_length_m,
            frame.score,
            frame.is_lost,
            True,
            frame.segment,
            frame.gap_s,
            frame.range_sigma_m,
            frame.covariance,
            np.full((3, 3), np.nan) if known is None else known,
        )
        if frame.is_unmeasured:
            self.unmeasured.add(frame.segment)
        self.stamps_ns.append(frame.stamp_ns)
        self.thinned.append(thinned)
        self.count += 1

    def correction(self, k: int) -> Correction:
        """Correction by key frame k."""
        before = max(k % self.count - 1, 0)
        return Correction(
            self.stamps_ns[k],
            SE2(*self.odom[k].tolist()),
            SE2(*self.map[k].tolist()),
            bool(self.segment[k] != self.segment[before]),
        )

    def newest_by_segment(self) -> dict[int, Correction]:
        """Corrections by the newest key frame, and by the newest one of another segment, to which the vehicle
        may have returned.
        """
        segment = int(self.segment[-1])
        newest = {segment: self.correction(self.count - 1)}
        others = np.flatnonzero(self.segment[self.stored :] != segment)
        if len(others):
            k = self.stored + int(others[-1])
            newest[int(self.segment[k])] = self.correction(k)
        return newest

    def keep(self, is_kept: npt.NDArray[np.bool_]) -> None:
        """Remove all others; is_kept (N,), True for those of a stored map."""
        self.by_hand = self.by_hand.without_keyframes(is_kept, self.map)
        self._rows = self._rows[: self.count][is_kept]
        self.stamps_ns = [stamp_ns for stamp_ns, keep in zip(self.stamps_ns, is_kept, strict=True) if keep]
        self.thinned = [scan for scan, keep in zip(self.thinned, is_kept, strict=True) if keep]
        self.count = int(is_kept.sum())

    def forget(self, k: int) -> None:
        """Remove the points of a key frame."""
        self.put_points(k, ThinnedScan(NO_POINTS, NO_NORMALS, self.thinned[k].sensor_xy_m))

    def put_points(self, k: int, thinned: ThinnedScan) -> None:
        """Replace the points of a key frame."""
        self.thinned[k] = thinned
        self.has_points[k] = len(thinned.xy_base) > 0

    def set_lost(self, keyframes: Iterable[int], is_lost: bool) -> None:
        """Mark the poses of some key frames as predictions, or as matches."""
        self.is_lost[list(keyframes)] = is_lost

    def forget_all(self, first: int, last: int) -> None:
        """Remove the points of the key frames first..last - 1."""
        for k in first + np.flatnonzero(self.has_points[first : max(first, last)]):
            self.forget(int(k))

    def forget_stationary(self, most: int, config: LoopsConfig) -> None:
        """Remove the points of the key frame before the newest `most`, if the vehicle was stationary.

        In a detached segment key frames are taken at standstill, too.
        """
        old = self.count - 1 - most
        before = self.stored + np.flatnonzero(self.has_points[self.stored : max(old, self.stored)])
        if not len(before) or self.segment[before[-1]] != self.segment[old]:
            return
        pose, kept = (SE2(*self.odom[k].tolist()) for k in (old, before[-1]))
        if not pose.is_step_from(kept, config.keyframe_distance_m, config.keyframe_turn_rad):
            self.forget(old)
