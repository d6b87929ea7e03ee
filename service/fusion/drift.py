"""How far the pose may be off since the start: the map's drift, and where the scan lies on the map."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.fusion.motion import Matched, Motion
from service.geometry.se2 import SE2
from service.kernels.drift import advance_drift, carry_covariance, join_information
from service.kernels.pose_information import invert_3x3

Matrix = npt.NDArray[np.float64]
Variances = npt.NDArray[np.float64]  # (3,) of x, y, theta in base axes
STANDING_M = 1e-6  # a shorter step shows nothing new


@dataclass(frozen=True, slots=True)
class WheelWalk:
    """How the error of dead reckoning grows, where no wall holds it."""

    m_per_sqrt_m: float
    rad_per_sqrt_m: float
    m_per_sqrt_s: float

    def over(self, step: SE2, elapsed_s: float) -> Variances:
        d = math.hypot(step.x_m, step.y_m)
        position = self.m_per_sqrt_m**2 * d + self.m_per_sqrt_s**2 * elapsed_s + 1e-12
        heading = self.rad_per_sqrt_m**2 * (d + abs(step.theta_rad)) + 1e-8
        return np.array([position, position, heading])


class MapDrift:
    """Covariance of the map around the vehicle, in the frame of the first scan.

    A match says where the vehicle is on the map, and the map was laid down from earlier matches. Each metre
    driven lays a new piece on the last one, with a part of a match's covariance as error. So drift is a
    random walk over the way: it does not shrink when a scan fits, nor grow while the vehicle stands. Where
    the points say little, dead reckoning is the smaller error, and information of both is added. The scale
    of the wheels is the same error all the way, which adds up in full: that part is kept as a vector.

    turn_m   m   a turn of a radian shows as much new as so many metres
    Source: information of independent sources adds, Thrun, Burgard, Fox, Probabilistic Robotics, section 3.5.
    """

    def __init__(self, turn_m: float) -> None:
        self._turn_m = turn_m
        self._covariance: Matrix = np.zeros((3, 3))
        self._along = np.zeros(3)  # error of the pose for an error of the wheels' scale by 1

    def covariance(self, scale_sigma: float) -> Matrix:
        """(3, 3) in base axes; scale_sigma: of the wheels' scale."""
        total: Matrix = self._covariance + scale_sigma**2 * np.outer(self._along, self._along)
        return total

    def add(self, covariance: Matrix) -> None:
        """(3, 3) in base axes: the map goes on from a pose that is so uncertain on the old one."""
        self._covariance += covariance

    def advance(self, step: SE2, walk: Variances, information: Matrix, per_m: float) -> None:
        """Go on by a step.

        walk          (3,)    what dead reckoning alone would have lost over the step
        information   (3, 3)  of the scan's points, in base axes; zero: the scan was not matched
        per_m         1/m     share of the points' covariance that a metre adds
        """
        way_m = math.hypot(step.x_m, step.y_m) + self._turn_m * abs(step.theta_rad)
        share = per_m * way_m if way_m > STANDING_M else 0.0
        advance_drift(self._covariance, self._along, as_vector(step), walk, information, share)


def as_vector(pose: SE2) -> npt.NDArray[np.float64]:
    return np.array([pose.x_m, pose.y_m, pose.theta_rad])


def carried(covariance: Matrix, step: SE2) -> Matrix:
    """(3, 3) covariance of a pose in base axes, after a step: a turn of the old base moves the new one."""
    result = np.empty((3, 3))
    carry_covariance(covariance, as_vector(step), result)
    return result


def on_the_map(information: Matrix, step_covariance: Matrix) -> Matrix:
    """(3, 3) covariance of a pose relative to the map: points and prediction together.

    step_covariance   (3, 3) of the prediction; zero: there was none
    """
    result = np.empty((3, 3))
    prior = np.zeros((3, 3))
    if step_covariance.any():
        invert_3x3(step_covariance, prior)
    join_information(information, prior, result)
    return result


def match_covariance(motion: Motion) -> Matrix:
    """(3, 3) of a pose against the map it was matched to, for those who do not care about the map's drift.

    The whole covariance where the motion comes from no match, or from one that does not tell it apart.
    """
    if not isinstance(motion, Matched):
        return motion.covariance
    result = np.empty((3, 3))
    join_information(motion.information, np.zeros((3, 3)), result)
    return result
