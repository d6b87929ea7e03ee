"""Where a lost vehicle is expected: by dead reckoning, else anywhere, or where the operator has set it."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import wrap_angle
from service.mapper.graph.model.candidate_submap import MIN_LOOP_SCORE, CandidateSubmap, cloud_of
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import Loop, loop_of
from service.mapper.graph.model.point_clouds import Fit, PointCloud
from service.mapper.graph.relocalise.known_map import MAX_QUERY, REFINE_WINDOW, fits
from service.mapper.graph.relocalise.place_search import EXPECTED_WINDOW
from service.mapper.judgement import JUMP_CHI2, is_loose, sigmas_of

ODOMETRY_PROBABILITY_UNMEASURED = 0.5  # that dead reckoning is right, after motion that no sensor measured
ODOMETRY_PROBABILITY_MEASURED = 0.9  # the same, where odometry measured the motion during a scan gap
ODOMETRY_PROBABILITY_CONTINUOUS = 0.9999  # the same, without a scan gap: the vehicle was not carried
# m, m, rad: error of a search result by distortion of the map.
SEARCH_COVARIANCE = np.diag([0.05**2, 0.05**2, 0.01**2])
SUBMAP_KEYFRAMES = 40  # around the pose, the nearest ones: 12 m of one pass
MAX_ATTEMPTS = 10  # key frames tried


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
        prior_information = np.linalg.inv(se2.rotated(self._of_find(), self.pose[2]))
        off = self.pose - fit.pose
        off[2] = wrap_angle(float(off[2]))
        information = fit.information + prior_information
        return Fit(fit.pose + np.linalg.solve(information, prior_information @ off), information, fit.share)

    def _chi2(self, pose: Floats) -> float:
        away = se2.between(self.pose, pose)
        return float(away @ np.linalg.solve(self._of_find(), away))

    def _of_find(self) -> Floats:
        return np.asarray(self.covariance + SEARCH_COVARIANCE)


class OperatorPose:
    """A pose set by the operator, until scans confirm or contradict it.

    refused   (m, m, rad) the newest pose that scans contradict, while its segment lasts; None: none
    """

    def __init__(self, keyframes: KeyframeList) -> None:
        self._keyframes = keyframes
        self._pose: Floats | None = None  # (3,) in the map, of the newest key frame when it was set
        self._pose_map_odom: Floats | None = None
        self._attempts_left = 0
        self.refused: tuple[float, float, float] | None = None
        self._refused_segment = 0

    def set(self, pose_map_base: Floats) -> None:
        """Expect the vehicle at a pose (3,) m, m, rad."""
        self._pose, self._pose_map_odom = pose_map_base, None
        self._attempts_left = MAX_ATTEMPTS
        self.refused = None

    def refuse(self, segment: int) -> None:
        """Give the pose up, if there is one: the segment lies elsewhere, or nowhere near it."""
        if self._pose is not None:
            x_m, y_m, theta_rad = self._pose.tolist()
            self._pose, self._refused_segment, self.refused = None, segment, (x_m, y_m, theta_rad)

    def find(self, segment: int, known: npt.NDArray[np.int64]) -> tuple[Floats, Loop] | None:
        """Pose (3,) of odom in the map, and the loop that proves it, if the segment fits near the pose.

        known   (K,) indices of the key frames with a known place

        The pose is given up after MAX_ATTEMPTS.
        """
        keyframes = self._keyframes
        if segment != self._refused_segment:
            self.refused = None
        own = np.flatnonzero((keyframes.segment == segment) & keyframes.is_usable)[-MAX_QUERY:]
        if self._pose is None or not len(own) or not len(known):
            return None
        if self._pose_map_odom is None:
            newest = keyframes.odom[keyframes.count - 1]
            self._pose_map_odom = se2.compose(self._pose, se2.between(newest, np.zeros(3)))
        reference = int(own[-1])
        at = se2.compose(self._pose_map_odom, keyframes.odom[reference])
        submap = self._around(known, at)
        loop = self._loop_near(submap, at, cloud_of(keyframes, own.tolist(), reference), reference)
        self._attempts_left -= 1
        if loop is None:
            if self._attempts_left == 0:
                self.refuse(segment)
            return None
        self._pose = None
        found = se2.compose(keyframes.map[submap.reference], loop.measured)
        return se2.compose(found, se2.between(keyframes.odom[reference], np.zeros(3))), loop

    def _around(self, known: npt.NDArray[np.int64], pose: Floats) -> CandidateSubmap:
        """Sub-map of the nearest key frames of all passes around a pose (3,) of the map."""
        keyframes = self._keyframes
        away_m = np.hypot(*(keyframes.map[known, :2] - pose[:2]).T)
        near = known[np.argsort(away_m, kind="stable")[:SUBMAP_KEYFRAMES]]
        return CandidateSubmap(keyframes, np.sort(near).tolist(), int(near[0]), keyframes.map)

    def _loop_near(
        self, submap: CandidateSubmap, at: Floats, cloud: PointCloud, reference: int
    ) -> Loop | None:
        """The loop of the points to a sub-map if they fit within EXPECTED_WINDOW of a pose (3,)."""
        guess = se2.between(self._keyframes.map[submap.reference], at)
        pose = submap.search(cloud, guess, *EXPECTED_WINDOW, MIN_LOOP_SCORE)
        if pose is None:
            return None
        fit = submap.align(cloud, pose)
        against = submap.against(cloud, fit.pose)
        if not fits(fit.share, against):
            return None
        return loop_of(
            submap.reference, reference, fit.pose, fit.information, fit.share, len(cloud.xy), against
        )
