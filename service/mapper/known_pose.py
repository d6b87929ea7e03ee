"""How well a pose is known in the map: by the graph up to a key frame, and by the motion model from there."""

import math
from dataclasses import dataclass

import numpy as np

from service.estimator.motion import Matrix, Motion
from service.geometry import poses as se2
from service.geometry.poses import Floats, Poses
from service.geometry.se2 import SE2


@dataclass(frozen=True, slots=True, eq=False)
class KnownPose:
    """A key frame that a graph has corrected.

    pose_odom_base      as the motion model gave it
    motion_covariance   (3, 3) of it against the first scan, as the motion model gave it; base axes
    covariance          (3, 3) of it in the map, as the graph knows it; base axes
    """

    pose_odom_base: SE2
    motion_covariance: Matrix
    covariance: Matrix

    def covariance_at(self, motion: Motion) -> Matrix:
        """(3, 3) of a later pose in the map: that of the key frame, and what motion has added since.

        Asked with every scan: carried and covariance_added, of one pose.
        """
        step = self.pose_odom_base.inverse() @ motion.pose_odom_base
        away = _adjoint_back(step)
        variances, axes = np.linalg.eigh(motion.covariance - away @ self.motion_covariance @ away.T)
        added = (axes * np.maximum(variances, 0.0)) @ axes.T
        return np.asarray(away @ self.covariance @ away.T + added)


def _adjoint_back(step: SE2) -> Matrix:
    """adjoint of the way back, from floats: at one pose the arrays of `carried` take four times as long."""
    c, s = math.cos(step.theta_rad), math.sin(step.theta_rad)
    return np.array(
        ((c, s, s * step.x_m - c * step.y_m), (-s, c, c * step.x_m + s * step.y_m), (0.0, 0.0, 1.0))
    )


def carried(covariance: Floats, step: Poses) -> Floats:
    """(..., 3, 3) covariances of poses in the axes of what lies a known step (..., 3) from each."""
    away = se2.adjoint(se2.between(step, np.zeros(3)))
    return np.asarray(away @ covariance @ np.swapaxes(away, -1, -2))


def covariance_added(before: Floats, after: Floats, step: Poses) -> Floats:
    """(..., 3, 3) what steps (..., 3) have added to the covariance of a pose; axes of their ends.

    before, after   (..., 3, 3) of the poses at both ends against one first scan, each in its own axes
    Never negative: what is learnt on the way, a scale of odometry, makes `before` smaller in hindsight.
    """
    variances, axes = np.linalg.eigh(after - carried(before, step))
    return np.asarray((axes * np.maximum(variances, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2))
