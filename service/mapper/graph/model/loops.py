"""Loops: measured relations between two passes of one place, and which of them are accepted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.pose_graph import Edges

FLOOR = np.diag([0.006**2, 0.006**2, 0.0015**2])  # m^2, rad^2: what walls and sweeps leave open at best
# 1/m^2, 1/rad^2: where walls say nothing, and many loops do not, either
OPEN_INFORMATION = np.diag([1e-4, 1e-4, 1e-2])
LOOP_KERNEL_SIGMAS = 2.0  # sigmas
WITHIN_M = 30.0  # way within which loops that say the same lie


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Key frame `to` seen from key frame `of`, of an earlier pass."""

    of: int
    to: int
    measured: Floats  # (3,)
    covariance: Floats  # (3, 3) in the axes of `to`
    share: float  # of the points that lie on the surfels of the earlier pass
    points: int = 0  # so many were asked; 0: not known
    against: float = math.nan  # share of them in free space of the earlier pass; NaN: not asked


def loop_of(
    of: int,
    to: int,
    pose: Floats,
    information: Floats,
    share: float,
    points: int = 0,
    against: float = math.nan,
) -> Loop:
    """information: (3, 3) in the axes of `of`. A direction that the walls do not fix stays open."""
    covariance = np.linalg.inv(information + OPEN_INFORMATION)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return Loop(of, to, pose, turn @ covariance @ turn.T + FLOOR, share, points, against)


def far_from_loops(at_m: Floats, tied_m: Floats, within_m: float) -> Floats:
    """Those of the places along the way (M,) m that lie farther than that from all that are tied, (L,) m."""
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


def disagreement(keyframes: KeyframeList, loop: Loop) -> tuple[float, float]:
    """m and rad between a loop and where the key frames lie in the map now."""
    here = se2.between(keyframes.map[loop.of], keyframes.map[loop.to])
    error = se2.between(loop.measured, here)
    return float(np.hypot(error[0], error[1])), float(abs(error[2]))


def agree(
    keyframes: KeyframeList, a: Loop, b: Loop, base: tuple[float, float], growth: tuple[float, float]
) -> bool:
    """Whether two loops say the same, as far as odometry between them can tell.

    base, growth   m, rad that they may differ by, at once and for each metre of way between them
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
