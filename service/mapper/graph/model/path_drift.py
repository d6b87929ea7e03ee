"""How far the way between two key frames can have drifted: it tells a loop from a place that looks alike."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.chi2 import CHI2_99_OF_3
from service.geometry.poses import Floats
from service.kernels.loops import path_lengths
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.odometry_edges import (
    UNKNOWN_COVARIANCE,
    lost_steps,
    odometry_edges,
    poor_match_steps,
)
from service.mapper.known_pose import carried

# Of three degrees of freedom, of a loop against the way between its ends: at most 20 in 1054 loops of seven
# recordings, 390 and more of those between shelves that look alike.
MAX_DRIFT_CHI2 = 60.0
# Of the way: what the covariance of the motion model leaves out, as a scan that is matched a metre off along
# a corridor and gives 1.6 m after 71 m of way. Aisles of shelves that look alike lie 9 % of the way apart.
UNMODELLED_SHARE = 0.003
# A loop that lies where the way leads is believed alone where the way is known this well: were it wrong, it
# would bend the map by no more than the way may have drifted by, and things that look alike lie farther apart
# than 3.5 sigma.
NEAR_SIGMA_M = 0.3
LOST_M, POOR_MATCH_M = 60.0, 30.0  # way that such a step counts for, where loops are looked for
LOOP_M = 1.0  # what going over a loop counts in the length of a path


class PathDrift:
    """The way by the motion model alone: other loops do not count.

    Where nothing was seen the way is known as odometry knows it. A vehicle that was carried there, and put
    down on new ground, gets no loop; but to allow for it would allow rows that look alike, for at their ends
    little is seen.
    """

    def __init__(self, keyframes: KeyframeList, step_m: float) -> None:
        """step_m: the way after which a key frame is due."""
        self._keyframes = keyframes
        self._step_m = step_m
        self._before = np.zeros(0, np.int64)  # (N - 1,) the key frame that each step begins at
        self._covariance = np.zeros((0, 3, 3))  # of the steps, as last asked

    def allows(self, loop: Loop) -> bool:
        """Whether the way can have drifted to where the loop is."""
        return loop.of > loop.to or self.chi2(loop) <= MAX_DRIFT_CHI2

    def confirms(self, loop: Loop) -> bool:
        """Whether it is where the way leads, and the way is known so well that it can hardly be elsewhere."""
        if loop.of > loop.to:
            return False
        path_covariance = self.covariance(loop)
        return (
            bool(np.sqrt(path_covariance[:2, :2].diagonal().max()) <= NEAR_SIGMA_M)
            and self.chi2(loop) <= CHI2_99_OF_3
        )

    def chi2(self, loop: Loop) -> float:
        """How far a loop is from where the way from `of` to a later `to` leads, in squared sigmas."""
        odom = self._keyframes.odom
        off = se2.between(se2.between(odom[loop.of], odom[loop.to]), loop.measured)
        return float(off @ np.linalg.solve(self.covariance(loop) + loop.covariance, off))

    def covariance(self, loop: Loop) -> Floats:
        """(3, 3) of the way from `of` to a later `to`, in the axes of `to`."""
        odom = self._keyframes.odom
        if len(self._covariance) != len(odom) - 1:
            self._update_steps()
        ends, begun_at = self._path_steps(loop.of, loop.to)
        steps = ends - 1
        path_covariance = carried(self._covariance[steps], se2.between(odom[ends], odom[loop.to])).sum(axis=0)
        path_covariance += (begun_at != loop.of) * UNKNOWN_COVARIANCE
        driven = odom[ends, :2] - odom[self._before[steps], :2]
        unmodelled_m = UNMODELLED_SHARE * np.hypot(driven[:, 0], driven[:, 1]).sum()
        return np.asarray(path_covariance + unmodelled_m**2 * np.diag([1.0, 1.0, 0.0]))

    def _path_steps(self, of: int, to: int) -> tuple[npt.NDArray[np.int64], int]:
        """Key frames that the steps from `of` to `to` end at, and the one that the first of them begins at.

        Pieces beside the way are none of it; where `of` lies in one of them, the way begins before it.
        """
        ends = []
        while to > of:
            ends.append(to)
            to = int(self._before[to - 1])
        return np.array(ends[::-1], np.int64), to

    def _update_steps(self) -> None:
        edges = odometry_edges(self._keyframes, self._step_m, is_by_motion=True)
        motion = self._keyframes.motion_covariance
        is_known = np.isfinite(motion[edges.of] + motion[edges.to]).all(axis=(1, 2))
        self._before = edges.of
        self._covariance = edges.covariance
        self._covariance[~is_known] = UNKNOWN_COVARIANCE


def lengths_from(keyframes: KeyframeList, loops: Sequence[Loop], k: int) -> Floats:
    """(N,) m of the shortest path from key frame k to each, over odometry and loops."""
    path_length_m = keyframes.path_length_m
    length_m = np.empty(len(path_length_m))
    of = np.array([loop.of for loop in loops], np.int64)
    to = np.array([loop.to for loop in loops], np.int64)
    step_m = (
        np.diff(path_length_m) + POOR_MATCH_M * poor_match_steps(keyframes) + LOST_M * lost_steps(keyframes)
    )
    path_lengths(np.append(step_m, 0.0), of, to, LOOP_M, k, length_m)
    return length_m
