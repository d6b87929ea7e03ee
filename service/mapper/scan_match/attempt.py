"""Data passed between the parts of the default profile's matcher."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.estimator.motion import Prediction
from service.geometry.se2 import SE2
from service.kernels.match import MatchResult, Prior
from service.mapper.components import Points
from service.mapper.judgement import Evidence, chi2_between, is_contradicted
from service.mapper.scan_match.posts import Posts
from service.mapper.scan_match.submaps import Submap
from service.outputs import Reason, State

Matrix = npt.NDArray[np.float64]


class Attempt(NamedTuple):
    """A scan to be aligned with a map, with its predicted pose there."""

    stamp_ns: int  # of the scan
    points: Points  # shifted along their walls, [24]
    unmoved: Points  # as measured
    normals: Matrix  # (N, 3) from estimate_normals
    posts: Posts | None  # where there are few walls
    predicted: Prediction
    prior: Prior
    usual_ratio: float  # recent inlier ratio of this laser's scans
    since_fix: tuple[float, float]  # time, s, and path, m, since a scan fixed the position


class Aligned(NamedTuple):
    """The result on one sub-map."""

    result: MatchResult
    pose: SE2
    xy_base: Matrix  # (N, 2) m, deskewed with the estimated twist
    submap: Submap
    state: State
    reason: Reason
    evidence: Evidence
    is_moving: npt.NDArray[np.bool_] | None = None  # as in Match

    def agreement(self, attempt: Attempt) -> float:
        """Share on walls of the points on known ground; 1 where the ground is unknown."""
        wrong = sum(
            self.submap.contradicting(attempt.points, self.xy_base, attempt.normals, self.result.pose)
        )
        on_map = self.result.share * self.result.used
        return on_map / (on_map + wrong) if wrong else 1.0

    @property
    def is_contradicted(self) -> bool:
        """Whether free space and walls of the map contradict it; False if the inlier ratio is high."""
        return is_contradicted(self.evidence)

    @property
    def advantage(self) -> float:
        """Share of the returns on the map, less that in its free space or behind its walls."""
        evidence = self.evidence
        return evidence.inlier_ratio - (evidence.in_free + (evidence.behind or 0.0)) / max(evidence.used, 1)


def turned_about(sensor_base: SE2, predicted: Prediction) -> Prediction:
    """The prediction of the base if a laser of this mounting were turned by 180 degrees."""
    forward_mps, left_mps, turn_radps = predicted.twist_base
    return replace(
        predicted,
        pose_odom_base=predicted.pose_odom_base @ SE2(2.0 * sensor_base.x_m, 2.0 * sensor_base.y_m, math.pi),
        twist_base=(-forward_mps, -left_mps, turn_radps),
    )


def chi2_of(pose: SE2, prior: Prior) -> float:
    """Chi2 of a pose against the prediction."""
    return chi2_between(SE2(*prior.pose.tolist()), pose, prior.covariance)
