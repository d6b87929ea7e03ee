"""Loops: relative poses between two passes of a place, and whether two of them agree."""

import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.pose_graph import Edges, Ints
from service.mapper.loop_evidence import BY_HAND, RefusedLoops

FLOOR = np.diag([0.006**2, 0.006**2, 0.0015**2])  # m^2, rad^2: systematic error of walls and sweeps
# 1/m^2, 1/rad^2: along directions without walls; many loops do not add up there
OPEN_INFORMATION = np.diag([1e-4, 1e-4, 1e-2])
LOOP_KERNEL_SIGMAS = 2.0  # Cauchy kernel
WITHIN_M = 30.0  # path length within which loops must agree
MAX_REFUSED = 1000  # the newest ones


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Relative pose of key frame `to` in key frame `of`, of an earlier pass."""

    of: int
    to: int
    measured: Floats  # (3,)
    covariance: Floats  # (3, 3) in the axes of `to`
    share: float  # inlier ratio on the surfels of the earlier pass
    points: int = 0  # number evaluated; 0: not known
    against: float = math.nan  # share of them in free space of the earlier pass; NaN: not known


def loop_of(
    of: int,
    to: int,
    pose: Floats,
    information: Floats,
    share: float,
    points: int = 0,
    against: float = math.nan,
) -> Loop:
    """A loop by a fit. information: (3, 3) in the axes of `of`, singular along directions without walls."""
    covariance = np.asarray(np.linalg.inv(information + OPEN_INFORMATION), np.float64)
    return Loop(of, to, pose, se2.rotated(covariance, -pose[2]) + FLOOR, share, points, against)


def far_from_loops(at_m: Floats, tied_m: Floats, within_m: float) -> Floats:
    """Positions along the path, (M,) m, farther than within_m from all positions of loops, (L,) m."""
    tied_m = np.concatenate(([-math.inf], np.sort(tied_m), [math.inf]))
    k = np.searchsorted(tied_m, at_m)
    return at_m[np.minimum(at_m - tied_m[k - 1], tied_m[k] - at_m) > within_m]


def as_edges(loops: Sequence[Loop]) -> Edges:
    if not loops:
        return Edges.none()
    return Edges(
        np.array([loop.of for loop in loops], np.int64),
        np.array([loop.to for loop in loops], np.int64),
        np.array([loop.measured for loop in loops]),
        np.array([loop.covariance for loop in loops]),
        np.full(len(loops), LOOP_KERNEL_SIGMAS),
    )


def loop_arrays(loops: Sequence[Loop]) -> dict[str, npt.NDArray[Any]]:
    """Loops as the arrays of a SavedGraph."""
    edges = as_edges(loops)
    return {
        "loop_ends": np.column_stack((edges.of, edges.to)).astype(np.int64),
        "loop_measured": edges.measured,
        "loop_covariance": edges.covariance,
        "loop_score": np.array([loop.share for loop in loops], np.float64),
        "loop_points": np.array([loop.points for loop in loops], np.int64),
        "loop_against": np.array([loop.against for loop in loops], np.float64),
    }


def loops_of(ends: Ints, measured: Floats, covariance: Floats, *figures: npt.NDArray[Any]) -> list[Loop]:
    """Inverse of loop_arrays. figures: score, points and against."""
    rows = zip(ends.tolist(), measured, covariance, *(of_all.tolist() for of_all in figures), strict=True)
    return [Loop(of, to, *others) for (of, to), *others in rows]


def agree(
    keyframes: KeyframeList, a: Loop, b: Loop, base: tuple[float, float], growth: tuple[float, float]
) -> bool:
    """Whether two loops agree, given odometry between them.

    base, growth   m, rad of tolerance, and per m of path between them
    """
    there = se2.compose(a.measured, se2.between(keyframes.odom[a.to], keyframes.odom[b.to]))
    back = se2.compose(se2.between(keyframes.odom[a.of], keyframes.odom[b.of]), b.measured)
    error = se2.between(there, back)
    path_length_m = keyframes.path_length_m
    path_m = abs(path_length_m[a.to] - path_length_m[b.to]) + abs(path_length_m[a.of] - path_length_m[b.of])
    return bool(
        np.hypot(error[0], error[1]) <= base[0] + growth[0] * path_m
        and abs(error[2]) <= base[1] + growth[1] * path_m
    )


class Refusals:
    """Refused loops by their key frames, with the latest reason."""

    def __init__(self, stored: RefusedLoops | None = None) -> None:
        self._by_ends: OrderedDict[tuple[int, int], tuple[Loop, int]] = OrderedDict()
        if stored is not None:
            unused = np.zeros((len(stored.ends), 3, 3))  # covariances
            loops = loops_of(
                stored.ends, stored.measured, unused, stored.score, stored.points, stored.against
            )
            for loop, reason in zip(loops, stored.reason.tolist(), strict=True):
                self.add([loop], reason)

    def add(self, loops: Iterable[Loop], reason: int) -> None:
        """reason: of service.mapper.loop_evidence."""
        for loop in loops:
            self._by_ends.pop((loop.of, loop.to), None)
            self._by_ends[loop.of, loop.to] = loop, reason
            if len(self._by_ends) > MAX_REFUSED:
                self._by_ends.popitem(last=False)

    def renumber(self, kept: Callable[[Sequence[Loop]], list[Loop]]) -> None:
        """kept: returns those of some loops whose ends both remain, renumbered."""
        rows = [(new, reason) for loop, reason in self._by_ends.values() for new in kept([loop])]
        self._by_ends = OrderedDict(((loop.of, loop.to), (loop, reason)) for loop, reason in rows)

    def by_hand(self, accepted: Collection[Loop]) -> list[Loop]:
        """Loops that the operator removed and did not accept again."""
        ends = {(loop.of, loop.to) for loop in accepted}
        return [loop for at, (loop, why) in self._by_ends.items() if why == BY_HAND and at not in ends]

    def arrays(self, accepted: Collection[Loop]) -> RefusedLoops:
        """Loops that are not accepted."""
        accepted_ends = {(loop.of, loop.to) for loop in accepted}
        left = [one for ends, one in self._by_ends.items() if ends not in accepted_ends]
        reasons = np.array([reason for _, reason in left], np.int64)
        return RefusedLoops.of(loop_arrays([loop for loop, _ in left]), reasons)
