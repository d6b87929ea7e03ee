"""How far the way between two key frames can have drifted: it tells a loop from a place that looks alike."""

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.known_pose import carried
from service.mapper.methods.corridor.graph.keyframe_list import KeyframeList
from service.mapper.methods.corridor.graph.loops import Loop
from service.mapper.methods.corridor.graph.odometry_edges import (
    LOST_COVARIANCE,
    UNKNOWN_COVARIANCE,
    lost_steps,
    odometry_edges,
)

# Of three degrees of freedom, of a loop against the way between its ends: at most 20 in 1054 loops of seven
# recordings, 390 and more of those between shelves that look alike.
MOST_DRIFT_CHI2 = 60.0
# Of the way: what the covariance of the motion model leaves out, as a scan that is matched a metre off along
# a corridor and gives 1.6 m after 71 m of way. Aisles of shelves that look alike lie 9 % of the way apart.
UNMODELLED_SHARE = 0.003


class WayDrift:
    """The way by the motion model alone: other loops do not count."""

    def __init__(self, keyframes: KeyframeList, step_m: float) -> None:
        """step_m: the way after which a key frame is due."""
        self._keyframes = keyframes
        self._step_m = step_m
        self._covariance = np.zeros((0, 3, 3))  # of the steps between key frames, as last asked

    def allows(self, loop: Loop) -> bool:
        """Whether the way can have drifted to where the loop is."""
        return loop.of > loop.to or self.chi2(loop) <= MOST_DRIFT_CHI2

    def chi2(self, loop: Loop) -> float:
        """How far a loop is from where the way from `of` to a later `to` leads, in squared sigmas."""
        odom = self._keyframes.odom
        if len(self._covariance) != len(odom) - 1:
            self._covariance = self._of_steps()
        ends = odom[loop.of + 1 : loop.to + 1]
        way = carried(self._covariance[loop.of : loop.to], se2.between(ends, odom[loop.to])).sum(axis=0)
        steps = odom[loop.of + 1 : loop.to + 1, :2] - odom[loop.of : loop.to, :2]
        unmodelled_m = UNMODELLED_SHARE * np.hypot(steps[:, 0], steps[:, 1]).sum()
        way += unmodelled_m**2 * np.diag([1.0, 1.0, 0.0])
        off = se2.between(se2.between(odom[loop.of], odom[loop.to]), loop.measured)
        return float(off @ np.linalg.solve(way + loop.covariance, off))

    def _of_steps(self) -> Floats:
        """(N - 1, 3, 3)."""
        steps = odometry_edges(self._keyframes, self._step_m, is_by_motion=True).covariance
        steps[lost_steps(self._keyframes)] += LOST_COVARIANCE  # odometry knows of no vehicle that is carried
        motion = self._keyframes.motion_covariance
        steps[~np.isfinite(motion[1:] + motion[:-1]).all(axis=(1, 2))] = UNKNOWN_COVARIANCE
        return steps
