"""Common part of the matchers of the papers: acceptance of a match, and search after a loss."""

from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from service.estimator.motion import Measurement, Motion, Prediction
from service.geometry.se2 import SE2
from service.kernels.filter_state import STUDENT
from service.mapper.components import KnownMap, Match, Points
from service.mapper.judgement import (
    GAP_S,
    JUMP_CHI2,
    MIN_AGREEMENT,
    Evidence,
    JudgementConfig,
    begun,
    chi2_between,
    is_loose,
    judge,
    sigmas_of,
    too_few,
    unmatched,
    weakest_of,
)
from service.mapper.maps.known_ground import KnownGround
from service.mapper.matchers.window_search import (
    LOST_WINDOW,
    MAX_WINDOW,
    MIN_INLIER_GAIN,
    SEARCH_INTERVAL_S,
    Confirmation,
    reach_of,
)
from service.outputs import Reason, State

Matrix = npt.NDArray[np.float64]

SEARCHED_COVARIANCE = np.diag([0.15**2, 0.15**2, 0.03**2])  # of the result of a search

MIN_COVARIANCE = 1e-12 * np.eye(3)  # of a search: its pose is compared with the prediction alone
CONFIRM_S = 0.1  # from a result to the search that is to confirm it
MAX_WIDENING = 16.0  # of the first window, after failed searches
MAX_SEARCH_INTERVAL_S = 1.0  # wide searches take longer, so they are less frequent
PREDICTION_KEPT = Reason(
    "prediction_stands",
    "the scan fits the map where the prediction puts it, and nowhere else in the window that was searched; "
    "the pose is the prediction. Drive on, to where more walls are in view",
)
RESTART_M = 5.0  # measured path of a lost vehicle after which a new map begins
UNCONFIRMED = Reason(
    "unconfirmed",
    "the scan fits the map at a place that the prediction allows; a second scan has to confirm it. Drive on",
)

SomeKnownMap = TypeVar("SomeKnownMap", bound=KnownMap)
KnownMap_contra = TypeVar("KnownMap_contra", bound=KnownMap, contravariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """The result of a matcher before it is judged."""

    measured: Measurement
    points: Points  # deskewed with the estimated twist


class Aligner(Protocol[KnownMap_contra]):
    """The part of a matcher that differs between the papers."""

    def align(
        self, points: Points, predicted: Prediction, local_map: KnownMap_contra, is_found: bool
    ) -> Aligned:
        """Align a scan with a map that is not empty; is_found: the prediction is the result of a search."""
        ...

    def search(
        self, points: Points, local_map: KnownMap_contra, pose: SE2, reach: tuple[float, float]
    ) -> SE2 | None:
        """The most likely pose within (m, rad) of a pose in odom; None where the map is unknown there."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _Verdict:
    state: State
    reason: Reason
    inlier_ratio: float


class JudgedMatching:
    """Aligns scans with a map, judges the result, and searches for the pose after a loss.

    On new ground few inliers decide nothing: the prediction is kept if it was measured and nothing
    contradicts it. A failed search doubles the next window. A result far from the prediction is a hypothesis,
    because rooms look alike, and must be confirmed by the next one. After RESTART_M of measured path without
    relocalisation the map there is missing or wrong; a new map begins at the prediction.
    """

    def __init__(self, limits: JudgementConfig) -> None:
        self._limits = limits
        self._is_lost = False
        self._next_search_ns = 0  # next search at the earliest
        self._widening = 1.0
        self._confirmation = Confirmation()
        self._lost_path_m = 0.0  # measured path length since the last match
        self._before: tuple[Points, SE2] | None = None  # the previous lost scan and its predicted pose

    def match(
        self, points: Points, predicted: Prediction, local_map: SomeKnownMap, aligner: Aligner[SomeKnownMap]
    ) -> Match:
        if reason := too_few(points):
            self._is_lost = True
            return unmatched(points, predicted, reason)
        if local_map.is_empty:
            return begun(points, predicted)
        match = self._placed(points, predicted, local_map, aligner)
        if match.state == "lost" and self._starts_over(points, predicted):
            local_map.start_over()
            words = f"{match.reason}; not relocalised over {self._lost_path_m:.0f} m: a new map begins here"
            match = Match(predicted, points, match.inlier_ratio, "degraded", Reason("new_map", words))
        self._is_lost = match.state == "lost"
        if not self._is_lost:
            self._next_search_ns, self._widening = 0, 1.0
            self._confirmation.clear()
            self._lost_path_m, self._before = 0.0, None
        return match

    def _placed(
        self, points: Points, predicted: Prediction, local_map: SomeKnownMap, aligner: Aligner[SomeKnownMap]
    ) -> Match:
        aligned = aligner.align(points, predicted, local_map, is_found=False)
        verdict = self._judged(aligned, predicted, local_map)
        if verdict.state != "lost" and (
            aligned.measured.is_joined or verdict.inlier_ratio >= self._limits.lost_ratio
        ):
            is_doubtful = self._is_lost and is_loose(sigmas_of(predicted.local_covariance))
            if is_doubtful and not self._is_confirmed(aligned, predicted):
                return unmatched(points, predicted, UNCONFIRMED, verdict.inlier_ratio)
            return _matched(aligned, predicted, verdict)
        as_predicted = self._judged_as_predicted(points, predicted, local_map)
        if as_predicted.state != "lost":
            return Match(
                predicted,
                points,
                as_predicted.inlier_ratio,
                "degraded",
                as_predicted.reason or PREDICTION_KEPT,
            )
        found = self._found(points, predicted, local_map, aligner, verdict.inlier_ratio)
        reason = verdict.reason if verdict.state == "lost" else as_predicted.reason
        return found or unmatched(points, predicted, reason, verdict.inlier_ratio)

    def _judged(
        self, aligned: Aligned, predicted: Prediction, local_map: KnownMap, is_found: bool = False
    ) -> _Verdict:
        """is_found: the pose is the result of a search, so the prediction is no evidence."""
        measured, prior = aligned.measured, predicted.local_covariance
        alone: Matrix = np.asarray(np.linalg.inv(measured.information), np.float64)
        joined: Matrix = measured.covariance
        if not measured.is_joined:
            joined = prior - prior @ np.linalg.solve(prior + measured.covariance, prior)
        is_far = is_found or (
            _chi2(aligned, predicted, measured.covariance) > JUMP_CHI2
            or (is_loose(sigmas_of(prior)) and (self._is_lost or predicted.elapsed_s > GAP_S))
        )
        overlap = local_map.overlap(aligned.points.xy_base, measured.pose_odom_base)
        evidence = Evidence(
            used=len(aligned.points.xy_base),
            on_map=overlap.on_map,
            in_free=overlap.in_free,
            sigma=sigmas_of(alone if is_found else joined),
            prior=sigmas_of(prior),
            is_measured=predicted.is_measured and not is_found,
            is_far=is_far,
            weakest=weakest_of(alone),
        )
        return self._verdict(evidence)

    def _judged_as_predicted(self, points: Points, predicted: Prediction, local_map: KnownMap) -> _Verdict:
        """Whether a scan that could not be matched fits the map at its predicted pose."""
        overlap = local_map.overlap(points.xy_base, predicted.pose_odom_base)
        prior = sigmas_of(predicted.local_covariance)
        evidence = Evidence(
            used=len(points.xy_base),
            on_map=overlap.on_map,
            in_free=overlap.in_free,
            sigma=prior,
            prior=prior,
            is_measured=predicted.is_measured,
            is_far=is_loose(prior) or not predicted.is_measured,
        )
        return self._verdict(evidence)

    def _verdict(self, evidence: Evidence) -> _Verdict:
        return _Verdict(*judge(evidence, self._limits), evidence.inlier_ratio)

    def _found(
        self,
        points: Points,
        predicted: Prediction,
        local_map: SomeKnownMap,
        aligner: Aligner[SomeKnownMap],
        ratio: float,
    ) -> Match | None:
        """A match elsewhere, with clearly more than `ratio` of the scan on the map; None: no such match."""
        stamp_ns = points.scan.stamp_ns
        if stamp_ns < self._next_search_ns:
            return None
        self._next_search_ns = stamp_ns + round(
            min(SEARCH_INTERVAL_S * self._widening, MAX_SEARCH_INTERVAL_S) * 1e9
        )
        reach_m, reach_rad = (
            min(max(reach, first) * self._widening, most)
            for reach, first, most in zip(
                reach_of(sigmas_of(predicted.local_covariance)), LOST_WINDOW, MAX_WINDOW, strict=True
            )
        )
        start = aligner.search(points, local_map, predicted.pose_odom_base, (reach_m, reach_rad))
        if start is not None:
            there = replace(predicted, pose_odom_base=start, local_covariance=SEARCHED_COVARIANCE)
            aligned = aligner.align(points, there, local_map, is_found=True)
            verdict = self._judged(aligned, predicted, local_map, is_found=True)
            if verdict.state != "lost" and verdict.inlier_ratio >= ratio + MIN_INLIER_GAIN:
                chi2 = _chi2(aligned, predicted, MIN_COVARIANCE)
                if chi2 > JUMP_CHI2 and not self._is_confirmed(aligned, predicted):
                    self._next_search_ns = stamp_ns + round(CONFIRM_S * 1e9)
                    return None
                return _matched(_alone(aligned, chi2), predicted, verdict)
        self._widening = min(2.0 * self._widening, MAX_WIDENING)
        return None

    def _is_confirmed(self, aligned: Aligned, predicted: Prediction) -> bool:
        return self._confirmation.confirms(aligned.measured.pose_odom_base, predicted.pose_odom_base)

    def _starts_over(self, points: Points, predicted: Prediction) -> bool:
        """Whether a lost vehicle has moved far enough and two scans agree: noise matches no previous scan."""
        if predicted.is_measured:
            self._lost_path_m += predicted.travel_m
        before, self._before = self._before, (points, predicted.pose_odom_base)
        if before is None or self._lost_path_m < RESTART_M:
            return False
        seen = KnownGround()
        seen.insert(*before)
        overlap = seen.overlap(points.xy_base, predicted.pose_odom_base)
        return (
            overlap.on_map >= self._limits.lost_ratio * len(points.xy_base)
            and overlap.agreement >= MIN_AGREEMENT
        )


def judged_alone(aligned: Aligned, predicted: Prediction, inliers: int, limits: JudgementConfig) -> Match:
    """The match of a matcher without search and free space.

    inliers   of the points
    """
    count = len(aligned.points.xy_base)
    prior = sigmas_of(predicted.local_covariance)
    sigma = sigmas_of(aligned.measured.covariance)
    evidence = Evidence(count, inliers, 0, sigma, prior, is_measured=False, is_far=False)
    state, reason = judge(evidence, limits)
    verdict = _Verdict(state, reason, evidence.inlier_ratio)
    if verdict.state == "lost":
        return unmatched(aligned.points, predicted, verdict.reason, verdict.inlier_ratio)
    return _matched(aligned, predicted, verdict)


def _matched(aligned: Aligned, predicted: Prediction, verdict: _Verdict) -> Match:
    measured = aligned.measured
    pose = measured.pose_odom_base
    motion = Motion(pose, predicted.twist_at(pose), measured.covariance)
    return Match(
        motion, aligned.points, verdict.inlier_ratio, verdict.state, verdict.reason, measured=measured
    )


def _alone(aligned: Aligned, chi2: float) -> Aligned:
    """The result of a search by the scan alone, to be fused with a prior of reduced weight."""
    measured = aligned.measured._replace(
        covariance=np.asarray(np.linalg.inv(aligned.measured.information), np.float64),
        prior_weight=min(1.0, (STUDENT + 3.0) / (STUDENT + chi2)),
        is_joined=False,
    )
    return replace(aligned, measured=measured)


def _chi2(aligned: Aligned, predicted: Prediction, covariance: Matrix) -> float:
    """Chi2 of the aligned pose against the prediction; covariance: added to that of the prediction."""
    return chi2_between(
        predicted.pose_odom_base, aligned.measured.pose_odom_base, predicted.local_covariance + covariance
    )
