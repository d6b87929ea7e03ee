"""What passes between the parts of the default profile's matcher."""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.estimator.motion import Prediction
from service.geometry.se2 import SE2
from service.kernels.match import MatchResult, Prior
from service.mapper.components import Points
from service.mapper.judgement import chi2_between
from service.mapper.scan_match.posts import Posts
from service.mapper.scan_match.submaps import Submap
from service.outputs import Reason, State

Matrix = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """A scan that is to be aligned with a map, and where the prediction puts it there."""

    points: Points  # where their beams meet walls
    unmoved: Points  # as they were measured
    normals: Matrix  # (N, 3) from estimate_normals
    posts: Posts | None  # where there are few walls
    predicted: Prediction
    prior: Prior
    usual_ratio: float  # inlier ratio of this laser's scans of late

    @property
    def stamp_ns(self) -> int:
        return self.points.scan.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Where it ended on one sub-map."""

    result: MatchResult
    xy_base: Matrix  # (N, 2) m, deskewed with the twist found
    submap: Submap
    state: State
    reason: Reason
    is_contradicted: bool  # by free space and walls of the map; False where too much lies on it to ask
    is_moving: npt.NDArray[np.bool_] | None = None  # as in Match

    def agreement(self, attempt: Attempt) -> float:
        """Share on walls of what ends on known ground; 1 where nothing is known, for nothing contradicts."""
        wrong = sum(
            self.submap.contradicting(attempt.points, self.xy_base, attempt.normals, self.result.pose)
        )
        on_map = self.result.share * self.result.used
        return on_map / (on_map + wrong) if wrong else 1.0

    @property
    def pose(self) -> SE2:
        x_m, y_m, theta_rad = self.result.pose.tolist()
        return SE2(x_m, y_m, theta_rad)


def turned_about(sensor_base: SE2, predicted: Prediction) -> Prediction:
    """Where the base would be if a laser that sits there looked the other way."""
    forward_mps, left_mps, turn_radps = predicted.twist_base
    return replace(
        predicted,
        pose_odom_base=predicted.pose_odom_base @ SE2(2.0 * sensor_base.x_m, 2.0 * sensor_base.y_m, math.pi),
        twist_base=(-forward_mps, -left_mps, turn_radps),
    )


def chi2_of(pose: SE2, prior: Prior) -> float:
    """How far a pose is from the prediction, in squared sigmas."""
    return chi2_between(SE2(*prior.pose.tolist()), pose, prior.covariance)
