"""Prior of the place of a lost vehicle: near dead reckoning, or uniform over the map."""

import math
from dataclasses import dataclass

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.mapper.graph.model.point_clouds import Fit
from service.mapper.graph.relocalise.known_map import REFINE_WINDOW
from service.mapper.judgement import JUMP_CHI2, is_loose, sigmas_of

ODOMETRY_PROBABILITY_UNMEASURED = 0.5  # that dead reckoning is right, after motion that no sensor measured
ODOMETRY_PROBABILITY_MEASURED = 0.9  # the same, where odometry measured the motion during a scan gap
ODOMETRY_PROBABILITY_CONTINUOUS = 0.9999  # the same, without a scan gap: the vehicle was not carried
# m, m, rad: error of a search result by distortion of the map.
SEARCH_COVARIANCE = np.diag([0.05**2, 0.05**2, 0.01**2])


def places_in(region: float) -> float:
    """Number of places in a region, m^2 rad, that a search distinguishes."""
    return region / _spread(SEARCH_COVARIANCE)


def _spread(covariance: Floats) -> float:
    """m^2 rad: inverse of the peak density of a normal distribution with covariance (3, 3)."""
    return float((2.0 * math.pi) ** 1.5 * math.sqrt(np.linalg.det(covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class OdometryPrior:
    """A mixture: a normal distribution at dead reckoning, and a uniform one over the map.

    pose         (3,) of a key frame in the map, by dead reckoning
    covariance   (3, 3) of it, base axes
    region       m^2 rad: area of the map times 2 pi
    probability  of the first component
    """

    pose: Floats
    covariance: Floats
    region: float
    probability: float = ODOMETRY_PROBABILITY_UNMEASURED

    def nats(self, pose: Floats) -> float:
        """Log-density at a pose (3,) of the map, minus that of the uniform distribution."""
        at = math.exp(-0.5 * self._chi2(pose)) / _spread(self._of_find())
        return math.log(1.0 - self.probability + self.probability * self.region * at)

    @property
    def is_vague(self) -> bool:
        """Whether dead reckoning is too uncertain to use."""
        return is_loose(sigmas_of(self.covariance))

    @property
    def window(self) -> tuple[float, float]:
        """Half the window about dead reckoning in which `explains` holds, m, rad; if vague a small one."""
        if self.is_vague:
            return REFINE_WINDOW[:2]
        x_m, y_m, theta_rad = np.sqrt(JUMP_CHI2 * np.diag(self._of_find())).tolist()
        return max(x_m, y_m), theta_rad

    def explains(self, pose: Floats) -> bool:
        """Whether a pose (3,) is within the gate of dead reckoning; False if that is too uncertain."""
        return not self.is_vague and self._chi2(pose) <= JUMP_CHI2

    def joined(self, fit: Fit) -> Fit:
        """A fit on the map, fused with dead reckoning."""
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
