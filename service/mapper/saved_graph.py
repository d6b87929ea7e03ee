"""The stored graph, with which a later session continues: key frames and the loops between them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.by_hand import ByHand
from service.mapper.loop_evidence import RefusedLoops

SESSION_APART_M = 100.0  # path length assumed from the last key frame of a session to the next session
POINT_STEP_M = 0.001  # of the stored coordinates: a tenth of the noise of a range
MAY_BE_NAN = ("gap_s", "loop_against")
# Arrays with a row per key frame, and per loop: the shape of a row.
KEYFRAME_ROWS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("stamp_ns", "path_length_m", "score", "gap_s", "segment"), ()),
    **dict.fromkeys(("is_lost", "range_sigma_m", "point_count"), ()),
    **dict.fromkeys(("odom", "map"), (3,)),
    "covariance": (3, 3),
    "sensor_xy_m": (2,),
}
LOOP_ROWS: dict[str, tuple[int, ...]] = {
    "loop_ends": (2,),
    "loop_measured": (3,),
    "loop_covariance": (3, 3),
    **dict.fromkeys(("loop_score", "loop_points", "loop_against"), ()),
}
KINDS = {  # dtypes; the others are floating
    **dict.fromkeys(("stamp_ns", "segment", "point_count", "loop_ends", "loop_points"), "i"),
    "is_lost": "b",
}
NORMAL_STEP = 1e-4  # of the stored normals and their weight
USUAL_RANGE_SIGMA_M = 0.012  # of an LMS-100: of a point of weight 1


class KeptGraph(NamedTuple):
    """Where the mapping process has stored a graph, reported in place of the graph itself."""

    folder: str  # of the graph; "" if it was empty
    fault: str  # why it was not stored, "" if it was


KeepGraph = Callable[["SavedGraph"], KeptGraph]


class SavedGraphError(ValueError):
    """Invalid arrays of a graph; the message names the array and the expected value."""


@dataclass(frozen=True, slots=True, eq=False)
class SavedGraph:
    """Key frames of one or more sessions in one map frame, and the loops between them.

    The N key frames are in the order driven. A session is one run of the mapper with an odom frame of its
    own. A segment is a part of the path that no odometry connects to the others; loops join it to the map.
    """

    stamp_ns: npt.NDArray[np.int64]  # (N,)
    odom: Floats  # (N, 3) pose_odom_base: m, m, rad
    map: Floats  # (N, 3) pose_map_base
    path_length_m: Floats  # (N,) path length up to each
    covariance: Floats  # (N, 3, 3) of the pose against the local map, base axes
    score: Floats  # (N,) inlier ratio on the local map
    gap_s: Floats  # (N,) longest time without a scan since the key frame before
    segment: npt.NDArray[np.int64]  # (N,)
    is_lost: npt.NDArray[np.bool_]  # (N,) the odom pose is a prediction
    range_sigma_m: Floats  # (N,) noise of its ranges
    sensor_xy_m: Floats  # (N, 2) base frame
    point_count: npt.NDArray[np.int64]  # (N,) points kept of each
    xy_base: npt.NDArray[np.float32]  # (M, 2) m, those of the first key frame first
    normals: npt.NDArray[np.float32]  # (M, 3) towards the sensor, and its weight
    loop_ends: npt.NDArray[np.int64]  # (L, 2) key frames
    loop_measured: Floats  # (L, 3) the second seen from the first
    loop_covariance: Floats  # (L, 3, 3) in the axes of the second
    loop_score: Floats  # (L,) inlier ratio
    loop_points: npt.NDArray[np.int64]  # (L,) evaluated; 0: not known
    loop_against: Floats  # (L,) share of them in free space; NaN: not known
    refused: RefusedLoops = field(default_factory=RefusedLoops)
    by_hand: ByHand = field(default_factory=ByHand)

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def of_keyframes(self, which: Any) -> dict[str, Any]:
        """The arrays of KEYFRAME_ROWS for some key frames."""
        return {name: getattr(self, name)[which] for name in KEYFRAME_ROWS}

    def of_loops(self, which: Any) -> dict[str, Any]:
        """The arrays of LOOP_ROWS for some loops."""
        return {name: getattr(self, name)[which] for name in LOOP_ROWS}

    def points(self) -> tuple[npt.NDArray[np.int64], Floats]:
        """The key frame of each point, (M,), and its position in the map, (M, 2) m."""
        of = np.repeat(np.arange(len(self)), self.point_count)
        return of, se2.points_from(self.map[of], self.xy_base.astype(np.float64))

    def without_points(self, gone: npt.NDArray[np.bool_]) -> "SavedGraph":
        """The graph without some points, (M,)."""
        of = np.repeat(np.arange(len(self)), self.point_count)
        return replace(
            self,
            point_count=np.bincount(of[~gone], minlength=len(self)).astype(np.int64),
            xy_base=self.xy_base[~gone],
            normals=self.normals[~gone],
        )

    def points_of(self, k: int) -> Floats:
        """(P, 2) m, the points of one key frame, base frame."""
        first = int(self.point_count[:k].sum())
        return self.xy_base[first : first + int(self.point_count[k])].astype(np.float64)

    def checked(self) -> "SavedGraph":
        """The graph itself. Raises SavedGraphError if the arrays do not fit each other or are not finite."""
        if self.stamp_ns.ndim != 1 or self.point_count.dtype.kind != "i" or self.loop_ends.ndim != 2:
            raise SavedGraphError("stamp_ns, point_count or loop_ends has the wrong type or shape")
        n, m, loops = len(self.stamp_ns), int(self.point_count.sum()), len(self.loop_ends)
        expected = {name: (n, *row) for name, row in KEYFRAME_ROWS.items()}
        expected |= {"xy_base": (m, 2), "normals": (m, 3)}
        expected |= {name: (loops, *row) for name, row in LOOP_ROWS.items()}
        for name, shape in expected.items():
            array = getattr(self, name)
            if array.dtype.kind not in KINDS.get(name, "f"):
                raise SavedGraphError(f"{name} is of {array.dtype}")
            if array.shape != shape:
                raise SavedGraphError(f"{name} has the shape {array.shape}, expected {shape}")
            if name not in MAY_BE_NAN and array.dtype.kind == "f" and not np.isfinite(array).all():
                raise SavedGraphError(f"{name} is not finite")
        if loops and (self.loop_ends.min() < 0 or self.loop_ends.max() >= n):
            raise SavedGraphError(f"loop_ends names key frames that are not among the {n} here")
        if (self.point_count < 0).any():
            raise SavedGraphError("point_count is negative")
        if problem := self.by_hand.problem(n) or self.refused.problem(n):
            raise SavedGraphError(problem)
        return self


_ELSEWHERE = ("xy_base", "normals", "by_hand", "refused")  # fields stored apart
_SMALL = tuple(f.name for f in fields(SavedGraph) if f.name not in _ELSEWHERE)


def small_arrays(graph: SavedGraph) -> dict[str, npt.NDArray[Any]]:
    """All arrays but the points, by their names in a file."""
    small = {name: getattr(graph, name) for name in _SMALL}
    return small | graph.by_hand.arrays() | graph.refused.arrays()


def packed_points(graph: SavedGraph, first: int, last: int) -> dict[str, npt.NDArray[Any]]:
    """Points of the key frames first..last - 1, as integer steps: a third of the size after compression."""
    ends = np.concatenate(([0], np.cumsum(graph.point_count)))
    part = slice(ends[first], ends[last])
    return {
        "xy": np.rint(graph.xy_base[part] / POINT_STEP_M).astype(np.int32),
        "normals": np.rint(graph.normals[part] / NORMAL_STEP).astype(np.int32),
    }


def from_arrays(
    small: Mapping[str, npt.NDArray[Any]], points: Sequence[Mapping[str, npt.NDArray[Any]]]
) -> SavedGraph:
    """Inverse of small_arrays and packed_points. Raises SavedGraphError."""
    try:
        xy = [np.asarray(part["xy"]) for part in points] or [np.zeros((0, 2), np.int32)]
        normals = [np.asarray(part["normals"]) for part in points] or [np.zeros((0, 3), np.int32)]
        graph = SavedGraph(
            xy_base=(np.concatenate(xy) * POINT_STEP_M).astype(np.float32),
            normals=(np.concatenate(normals) * NORMAL_STEP).astype(np.float32),
            by_hand=ByHand.from_arrays(small),
            refused=RefusedLoops.from_arrays(small),
            **{name: small[name] for name in _SMALL},
        )
    except (KeyError, ValueError, TypeError) as error:
        raise SavedGraphError(f"arrays that are no graph: {error}") from error
    return graph.checked()
