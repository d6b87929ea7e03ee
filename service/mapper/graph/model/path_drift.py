"""Drift of the path between two key frames, which separates loops from places that look alike."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.chi2 import CHI2_99_OF_3
from service.geometry.poses import Floats
from service.kernels.loops import path_lengths
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.odometry_edges import odometry_edges
from service.mapper.graph.model.pose_graph import UNKNOWN_COVARIANCE
from service.mapper.known_pose import carried

# Gate of three degrees of freedom, loop against path: at most 20 in 1054 loops of seven recordings, 390 and
# more for loops between shelves that look alike.
MAX_DRIFT_CHI2 = 60.0
# Of the path: error that the motion model's covariance omits, as a match 1 m off along a corridor, which
# makes 1.6 m after 71 m of path. Aisles of shelves that look alike are 9 % of the path apart.
UNMODELLED_SHARE = 0.003
# A single loop is accepted if it agrees with odometry of this uncertainty: a wrong one would move the map by
# no more than the drift, and places that look alike are more than 3.5 sigma apart.
NEAR_SIGMA_M = 0.3
LOOP_M = 1.0  # path length added for passing a loop


class PathDrift:
    """Path by the motion model alone, without other loops.

    Without matches the path is known as odometry measures it. A vehicle carried to new ground gets no loop;
    allowing for that would accept rows of vines or shelves that look alike, at whose ends little is visible.
    """

    def __init__(self, keyframes: KeyframeList, step_m: float) -> None:
        """step_m: path length after which a key frame is due."""
        self._keyframes = keyframes
        self._step_m = step_m
        self.forget()

    def forget(self) -> None:
        """Key frames were removed or have other numbers."""
        self._before = np.zeros(0, np.int64)  # (N - 1,) first key frame of each step
        self._covariance = np.zeros((0, 3, 3))  # of the steps, at the last update

    def allows(self, loop: Loop) -> bool:
        """Whether the loop is within the drift of the path."""
        return loop.of > loop.to or self.chi2(loop) <= MAX_DRIFT_CHI2

    def confirms(self, loop: Loop) -> bool:
        """Whether the loop agrees with odometry, and odometry is precise enough to accept it alone."""
        if loop.of > loop.to:
            return False
        path_covariance = self.covariance(loop)
        return (
            bool(np.sqrt(path_covariance[:2, :2].diagonal().max()) <= NEAR_SIGMA_M)
            and self.chi2(loop) <= CHI2_99_OF_3
        )

    def chi2(self, loop: Loop) -> float:
        """Squared Mahalanobis distance of a loop to the path from `of` to a later `to`."""
        odom = self._keyframes.odom
        off = se2.between(se2.between(odom[loop.of], odom[loop.to]), loop.measured)
        return float(off @ np.linalg.solve(self.covariance(loop) + loop.covariance, off))

    def covariance(self, loop: Loop) -> Floats:
        """(3, 3) of the path from `of` to a later `to`, in the axes of `to`."""
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
        """Key frames at the ends of the steps from `of` to `to`, and the first one of the first step.

        Segments beside the path are skipped; if `of` lies in one of them, the path begins before it.
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


def drift_from(
    keyframes: KeyframeList, loops: Sequence[Loop], k: int, step_m: float, drift: tuple[float, float]
) -> tuple[Floats, Floats]:
    """(N,) m and (N,) rad: sigma of the pose of key frame k against each, over odometry and loops.

    A drift (m, rad per m of the shortest path) and the errors of the steps on the path of least variance.

    step_m   path length after which a key frame is due
    """
    steps = odometry_edges(keyframes, step_m).covariance
    turn_rad2 = steps[:, 2, 2]
    away_m = np.hypot(*(keyframes.map[1:, :2] - keyframes.map[k, :2]).T)
    position_m2 = np.maximum(steps[:, 0, 0], steps[:, 1, 1]) + turn_rad2 * away_m**2
    of = np.array([loop.of for loop in loops], np.int64)
    to = np.array([loop.to for loop in loops], np.int64)
    length_m, sum_m2, sum_rad2 = np.empty((3, keyframes.count))
    for of_step, of_loop, sums in (
        (np.diff(keyframes.path_length_m), LOOP_M, length_m),
        (position_m2, 0.0, sum_m2),
        (turn_rad2, 0.0, sum_rad2),
    ):
        path_lengths(np.append(of_step, 0.0), of, to, of_loop, k, sums)
    drift_m, drift_radpm = drift
    return np.hypot(drift_m * length_m, np.sqrt(sum_m2)), np.hypot(drift_radpm * length_m, np.sqrt(sum_rad2))
