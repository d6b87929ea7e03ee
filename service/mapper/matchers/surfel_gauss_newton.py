"""The matcher of the default profile: Gauss-Newton on surfels, with a coarse map to fall back on."""

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from service.fusion.motion import Measurement, Motion, Prediction
from service.geometry.se2 import SE2
from service.kernels.deskew import Returns
from service.kernels.match import MatchResult, MatchSettings, Prior, match_scan
from service.mapper.judgement import Evidence, Ratios, judge, sigmas_of
from service.mapper.maps.submaps import Submap, SurfelSubmaps
from service.mapper.matchers.recovery import search_around
from service.mapper.stages import Match, Points
from service.outputs import State

Matrix = npt.NDArray[np.float64]

LEAST_POINTS = 20  # with fewer a scan is not matched
INLIER_M = 0.10  # a point this near to its surfel lies on the map
LEAST_NORMAL_COSINE = 0.6  # between a point and a surfel of the same wall
ITERATIONS, DESKEW_ROUNDS = 15, 8
SETTLED_M, SETTLED_RAD = 5e-4, 1e-4
COARSE_SIGMA, COARSE_BEAMS, COARSE_ITERATIONS = 0.3, 180, 15  # sigma of 1 - likelihood
SAME_WALL_M = 0.05  # scans within one key frame's distance are matched to the same noise of the map
MOST_REPEATS = 100.0
USUAL_SCANS = 50  # over which the usual inlier ratio is taken
DOUBT_RATIO = 0.9  # of the usual inlier ratio: with less, other starts are tried
SEARCH_GAIN = 0.08  # so much more must lie on the map where a search leads
SEARCH_REST_S = 0.5  # between two searches of the whole window
LEAST_SEARCH = (0.3, 0.2)  # m, rad: windows of a search, half their width
MOST_SEARCH = (8.0, math.pi)
FIRST_SEARCH = (2.0, 1.6)  # of a scan that is lost though the prediction is good
GAP_S = 2.5  # without a scan, after which a loose prediction is a gap in the way
LOOSE_SIGMAS = (0.5, 0.4)  # m, rad: a prediction worse than that is searched around
SAME_FIND_M, SAME_FIND_RAD = 0.3, 0.06  # two finds of a lost vehicle agree
JUMP_CHI2 = 27.9  # 99.999 % of three degrees of freedom


class SurfelMatcherConfig(BaseModel):
    """How a scan is laid on the sub-map, and when the result is believed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    wall_sigma_m: float = Field(default=0.004, gt=0.0)  # how even walls are
    cauchy_m: float = Field(default=0.10, gt=0.0)  # a point so far off counts half
    lost_ratio: float = Field(default=0.30, ge=0.0, le=1.0)
    degraded_ratio: float = Field(default=0.45, ge=0.0, le=1.0)
    degraded_sigma_m: float = Field(default=0.10, gt=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class _Attempt:
    """A scan that is to be laid on a map, and where the prediction puts it there."""

    points: Points
    normals: Matrix  # (N, 3) from estimate_normals
    predicted: Prediction
    prior: Prior


@dataclass(frozen=True, slots=True, eq=False)
class _Laid:
    """Where it ended on one sub-map."""

    result: MatchResult
    xy_base: Matrix  # (N, 2) m, deskewed with the twist found
    submap: Submap
    state: State
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class _Gap:
    """Where a detached piece of the map began, and how well that was known in the map before."""

    pose: SE2
    covariance: Matrix  # (3, 3) base axes


class SurfelGaussNewton:
    """Matcher[SurfelSubmaps]."""

    def __init__(self, config: SurfelMatcherConfig) -> None:
        self._config = config
        self._ratios = Ratios(config.lost_ratio, config.degraded_ratio)
        self._settings = MatchSettings(
            range_sigma_m=0.01,
            wall_sigma_m=config.wall_sigma_m,
            repeats=1.0,
            cauchy_m=config.cauchy_m,
            least_normal_cosine=LEAST_NORMAL_COSINE,
            iterations=ITERATIONS,
            deskew_rounds=DESKEW_ROUNDS,
            inlier_m=INLIER_M,
            coarse_sigma=COARSE_SIGMA,
            coarse_beams=COARSE_BEAMS,
            coarse_iterations=COARSE_ITERATIONS,
            settled_m=SETTLED_M,
            settled_rad=SETTLED_RAD,
        )
        self._usual_ratio = 1.0
        self._rest_until_ns = 0  # no wide search before
        self._gap: _Gap | None = None
        self._began: _Gap | None = None  # the gap of a piece that would begin with this scan
        self._detached: Submap | None = None  # the piece that `gap` belongs to
        self._hypothesis: SE2 | None = None  # odom of the piece in that of the map, where a find put it

    def match(self, points: Points, predicted: Prediction, local_map: SurfelSubmaps) -> Match:
        if len(points.xy_base) < LEAST_POINTS:
            return Match(predicted, points, 0.0, "lost", self._too_few(points))
        submap = local_map.matched_to
        if submap is None:
            return Match(predicted, points, 1.0)
        if local_map.detached is None:
            self._gap = None
            self._detached = None
        elif local_map.detached is not self._detached:  # a piece that begins where the prediction puts it
            self._detached = local_map.detached
            self._gap, self._hypothesis = self._began, None
        attempt = _Attempt(points, local_map.normals_of(points), predicted, _prior_of(predicted, self._gap))
        laid = self._searched(self._lay(attempt, attempt.prior.pose, submap), attempt)
        if laid.state != "lost" and self._is_found(laid, attempt):
            self._usual_ratio += (laid.result.share - self._usual_ratio) / USUAL_SCANS
            return self._as_match(laid, attempt, laid.state, laid.reason)
        self._began = _Gap(predicted.pose_odom_base, attempt.prior.covariance)
        if local_map.detached is None:
            return Match(predicted, points, laid.result.share, "lost", laid.reason)
        attempt = replace(attempt, prior=_prior_of(predicted, None))
        detached = self._lay(attempt, attempt.prior.pose, local_map.detached)
        if detached.state == "lost":
            return Match(predicted, points, laid.result.share, "lost", laid.reason)
        return self._as_match(
            detached, attempt, "lost", f"{laid.reason}; what is seen now is mapped apart until it is found"
        )

    def _is_found(self, laid: _Laid, attempt: _Attempt) -> bool:
        """Whether a scan that was mapped apart is believed to lie on the map again.

        One find far from the prediction is a hypothesis, since rooms look alike; the next one must say the
        same. A find that the way so far rules out is none: where else it may be the graph looks.
        """
        if self._gap is None:
            return True
        is_loose = _is_loose(sigmas_of(attempt.prior.covariance))
        if _chi2(laid.result.pose, attempt.prior) > JUMP_CHI2:
            return False
        if not is_loose:
            return True
        jump = SE2(*laid.result.pose.tolist()) @ attempt.predicted.pose_odom_base.inverse()
        last, self._hypothesis = self._hypothesis, jump
        if last is None:
            return False
        there = last @ attempt.predicted.pose_odom_base
        away = SE2(*laid.result.pose.tolist()).inverse() @ there
        return math.hypot(away.x_m, away.y_m) < SAME_FIND_M and abs(away.theta_rad) < SAME_FIND_RAD

    def _as_match(self, laid: _Laid, attempt: _Attempt, state: State, reason: str) -> Match:
        result = laid.result
        x_m, y_m, theta_rad = result.pose.tolist()
        forward, left, turn = result.twist.tolist()
        pose = SE2(x_m, y_m, theta_rad)
        gap = None
        if state != "lost" and self._gap is not None:
            gap = attempt.prior.covariance - attempt.predicted.local_covariance
        measured = Measurement(pose, result.covariance, result.information, result.prior_weight, gap)
        motion = Motion(pose, (forward, left, turn), result.covariance)
        deskewed = replace(attempt.points, xy_base=laid.xy_base)
        return Match(motion, deskewed, result.share, state, reason, laid.submap.number, measured)

    def _lay(self, attempt: _Attempt, start: Matrix, submap: Submap) -> _Laid:
        """The match on a sub-map, begun at `start`, a pose as in the prior, and what to think of it."""
        points = attempt.points
        xy_base = points.xy_base.copy()
        apart_m = max(attempt.predicted.travel_m, SAME_WALL_M / MOST_REPEATS)
        result: MatchResult = match_scan(
            Returns(points.xy_raw, points.beam_time_s, points.beam),
            submap.weighed(points, attempt.normals, start),
            attempt.prior,
            start,
            submap.grid(),
            self._settings._replace(
                range_sigma_m=points.range_sigma_m, repeats=max(1.0, SAME_WALL_M / apart_m)
            ),
            DOUBT_RATIO * self._usual_ratio,
            xy_base,
        )
        return _Laid(result, xy_base, submap, *self._judge(result, xy_base, attempt, submap))

    def _judge(
        self, result: MatchResult, xy_base: Matrix, attempt: _Attempt, submap: Submap
    ) -> tuple[State, str]:
        prior = sigmas_of(attempt.prior.covariance)
        is_far = _chi2(result.pose, attempt.prior) > JUMP_CHI2 or (
            _is_loose(prior) and (self._gap is not None or attempt.predicted.elapsed_s > GAP_S)
        )
        in_free = 0
        if is_far or result.share < DOUBT_RATIO * self._usual_ratio:
            in_free = submap.in_free(xy_base, attempt.normals, result.pose)
        evidence = Evidence(
            used=result.used,
            on_map=result.share * result.used,
            in_free=in_free,
            sigma=sigmas_of(result.covariance),
            prior=prior,
            is_measured=attempt.predicted.is_measured,
            is_far=is_far,
        )
        state, reason = judge(evidence, self._ratios)
        if state == "ok" and result.weakest_sigma_m > self._config.degraded_sigma_m:
            towards_deg = math.degrees(result.weakest_direction_rad) % 180.0
            return "degraded", (
                f"the walls in view do not fix the position along {towards_deg:.0f} deg of the vehicle "
                f"(sigma {result.weakest_sigma_m:.2f} m); the prediction holds it"
            )
        return state, reason

    def _searched(self, laid: _Laid, attempt: _Attempt) -> _Laid:
        """The best pose of a window around the prediction, if clearly more of the scan lies on the map there.

        A poor recovery is worse than none: a prediction that goes on is found again, a jump is not.
        """
        sigma_m, sigma_rad = sigmas_of(attempt.prior.covariance)
        share = laid.result.share
        if laid.state != "lost" and (
            not _is_loose((sigma_m, sigma_rad)) or share >= DOUBT_RATIO * self._usual_ratio
        ):
            return laid
        reach_m, reach_rad = (
            min(max(3.0 * sigma, least), most)
            for sigma, least, most in zip((sigma_m, sigma_rad), LEAST_SEARCH, MOST_SEARCH, strict=True)
        )
        if laid.state == "lost":
            if attempt.points.scan.stamp_ns < self._rest_until_ns:
                return laid
            self._rest_until_ns = attempt.points.scan.stamp_ns + round(SEARCH_REST_S * 1e9)
            reach_m, reach_rad = max(reach_m, FIRST_SEARCH[0]), max(reach_rad, FIRST_SEARCH[1])
        prior = attempt.prior
        start = search_around(attempt.points.xy_base, prior.pose, reach_m, reach_rad, laid.submap.grid())
        if start is None:
            return laid
        found = self._lay(attempt, start, laid.submap)
        return found if found.state != "lost" and found.result.share >= share + SEARCH_GAIN else laid

    def _too_few(self, points: Points) -> str:
        return (
            f"{points.scan.sensor}: {len(points.xy_base)} of {len(points.scan.range_m)} beams returned "
            f"(at least {LEAST_POINTS}); is the window covered, or is there nothing in range?"
        )


def _is_loose(sigmas: tuple[float, float]) -> bool:
    """Whether a prediction known to so many m and rad says little of where the match must lie."""
    return sigmas[0] > LOOSE_SIGMAS[0] or sigmas[1] > LOOSE_SIGMAS[1]


def _chi2(pose: Matrix, prior: Prior) -> float:
    """How far a pose (3,) is from the prediction, in squared sigmas."""
    away = SE2(*prior.pose.tolist()).inverse() @ SE2(*pose.tolist())
    offset = np.array([away.x_m, away.y_m, away.theta_rad])
    return float(offset @ np.linalg.solve(prior.covariance, offset))


def _prior_of(predicted: Prediction, gap: _Gap | None) -> Prior:
    """The prediction as the kernel wants it; gap: of a piece that it is carried through, against the map."""
    pose = predicted.pose_odom_base
    covariance = predicted.local_covariance
    if gap is not None:
        step = gap.pose.inverse() @ pose
        c, s = math.cos(step.theta_rad), math.sin(step.theta_rad)
        carry = np.array(
            [
                [c, s, s * step.x_m - c * step.y_m],
                [-s, c, c * step.x_m + s * step.y_m],
                [0.0, 0.0, 1.0],
            ]
        )
        covariance = covariance + carry @ gap.covariance @ carry.T
    return Prior(
        np.array([pose.x_m, pose.y_m, pose.theta_rad]),
        np.array(predicted.twist_base),
        covariance,
        predicted.twist_gain,
    )
