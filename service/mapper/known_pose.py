"""Covariance of a pose in the map: by the graph up to a key frame, by the motion model after it."""

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

    pose_odom_base      of the motion model
    motion_covariance   (3, 3) against the first scan, of the motion model; base axes
    covariance          (3, 3) in the map, of the graph; base axes
    """

    pose_odom_base: SE2
    motion_covariance: Matrix
    covariance: Matrix

    def covariance_at(self, motion: Motion) -> Matrix:
        """(3, 3) of a later pose in the map: that of the key frame plus what motion has added.

        Evaluated with every scan: `carried` and `covariance_added` for a single pose.
        """
        step = self.pose_odom_base.between(motion.pose_odom_base)
        away = adjoint_back(step)
        variances, axes = np.linalg.eigh(motion.covariance - away @ self.motion_covariance @ away.T)
        added = (axes * np.maximum(variances, 0.0)) @ axes.T
        return np.asarray(away @ self.covariance @ away.T + added)


def adjoint_back(step: SE2) -> Matrix:
    """Adjoint of the inverse step, from floats: a quarter of the time of `carried` for a single pose."""
    c, s = math.cos(step.theta_rad), math.sin(step.theta_rad)
    return np.array(
        ((c, s, s * step.x_m - c * step.y_m), (-s, c, c * step.x_m + s * step.y_m), (0.0, 0.0, 1.0))
    )


def carried(covariance: Floats, step: Poses) -> Floats:
    """(..., 3, 3) covariances of poses, transported by known steps (..., 3) to the axes of their ends."""
    away = se2.adjoint(se2.between(step, np.zeros(3)))
    return np.asarray(away @ covariance @ np.swapaxes(away, -1, -2))


def covariance_added(before: Floats, after: Floats, step: Poses) -> Floats:
    """(..., 3, 3) covariance that steps (..., 3) add to a pose; axes of their ends.

    before, after   (..., 3, 3) of the poses at both ends against one first scan, each in its own axes
    Clipped to be positive semidefinite: a parameter estimated later, as the odometry scale, reduces `before`
    in hindsight.
    """
    variances, axes = np.linalg.eigh(after - carried(before, step))
    return np.asarray((axes * np.maximum(variances, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2))
