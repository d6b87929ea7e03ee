"""How likely places are for a vehicle that was lost: where dead reckoning says, or anywhere."""

import math
from dataclasses import dataclass

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.mapper.graph.model.point_clouds import Fit
from service.mapper.judgement import JUMP_CHI2, is_loose, sigmas_of

ODOMETRY_PROBABILITY_UNMEASURED = (
    0.5  # probability that dead reckoning is right after a pause; the other hypothesis is equally likely
)
ODOMETRY_PROBABILITY_MEASURED = 0.9  # the same, where odometry measured the way while scans were missing
ODOMETRY_PROBABILITY_CONTINUOUS = 0.9999  # the same, where no scan was missing: the vehicle was not carried
# Of the place that a search finds, m, m, rad: what key frames of the map are off besides.
SEARCH_COVARIANCE = np.diag([0.05**2, 0.05**2, 0.01**2])


def places_in(region: float) -> float:
    """How many places that a search tells apart lie in a region, m^2 rad."""
    return region / _spread(SEARCH_COVARIANCE)


def _spread(covariance: Floats) -> float:
    """m^2 rad that a normal distribution (3, 3) takes up: one over its greatest density."""
    return float((2.0 * math.pi) ** 1.5 * math.sqrt(np.linalg.det(covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPrior:
    """A mixture of two hypotheses: a normal distribution about dead reckoning, and all of the map alike.

    pose         (3,) where dead reckoning puts a key frame, in the map
    covariance   (3, 3) of it, base axes
    region       m^2 rad: ground of the map times a full turn
    drove        probability of the first hypothesis
    """

    pose: Floats
    covariance: Floats
    region: float
    probability: float = ODOMETRY_PROBABILITY_UNMEASURED

    def nats(self, pose: Floats) -> float:
        """Log-density at a pose (3,) of the map, less that of a vehicle that may be anywhere in it."""
        at = math.exp(-0.5 * self._chi2(pose)) / _spread(self._of_find())
        return math.log(1.0 - self.probability + self.probability * self.region * at)

    @property
    def is_vague(self) -> bool:
        """Whether dead reckoning knows too little to lead anywhere."""
        return is_loose(sigmas_of(self.covariance))

    def explains(self, pose: Floats) -> bool:
        """Whether a pose (3,) is where dead reckoning leads, but for chance; one that knows little says
        nothing.
        """
        return not self.is_vague and self._chi2(pose) <= JUMP_CHI2

    def joined(self, fit: Fit) -> Fit:
        """What a fit on the map and dead reckoning say together."""
        c, s = math.cos(self.pose[2]), math.sin(self.pose[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        prior_information = np.linalg.inv(turn @ self._of_find() @ turn.T)
        off = self.pose - fit.pose
        off[2] = wrap_angle(float(off[2]))
        information = fit.information + prior_information
        return Fit(fit.pose + np.linalg.solve(information, prior_information @ off), information, fit.share)

    def _chi2(self, pose: Floats) -> float:
        away = se2.between(self.pose, pose)
        return float(away @ np.linalg.solve(self._of_find(), away))

    def _of_find(self) -> Floats:
        return np.asarray(self.covariance + SEARCH_COVARIANCE)
