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
from service.mapper.maps.submaps import Submap, SurfelSubmaps
from service.mapper.matchers.recovery import search_around
from service.mapper.stages import Match, Points
from service.outputs import State


class SurfelMatcherConfig(BaseModel):
    """How a scan is laid on the sub-map, and when the result is believed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    wall_sigma_m: float = Field(default=0.004, gt=0.0)
    same_wall_m: float = Field(default=0.05, gt=0.0)
    most_repeats: float = Field(default=100.0, ge=1.0)
    cauchy_m: float = Field(default=0.10, gt=0.0)
    least_normal_cosine: float = Field(default=0.6, ge=-1.0, lt=1.0)
    iterations: int = Field(default=15, ge=1, le=100)
    deskew_rounds: int = Field(default=8, ge=0, le=100)
    coarse_sigma: float = Field(default=0.3, gt=0.0)  # of 1 - likelihood
    coarse_beams: int = Field(default=180, ge=10)
    coarse_iterations: int = Field(default=15, ge=0, le=100)

    jump_sigmas: float = Field(default=4.0, gt=0.0)  # from the prediction: then a doubtful match is refused
    doubt_ratio: float = Field(default=0.9, ge=0.0, le=1.0)  # of the usual share on the map
    # The window of the search: the most where too little lies on the map; three sigmas of the prediction,
    # within these, where a guess without wheels fits worse than usual.
    search_least_m: float = Field(default=0.3, gt=0.0)
    search_most_m: float = Field(default=2.0, gt=0.0)
    search_least_rad: float = Field(default=0.2, gt=0.0)
    search_most_rad: float = Field(default=1.6, gt=0.0)
    search_gain: float = Field(default=0.08, ge=0.0)  # so much more must then lie on the map
    search_rest_s: float = Field(default=1.0, ge=0.0)  # between two searches of the whole window
    usual_share_scans: int = Field(default=50, ge=1)  # over which the usual share is taken
    settled_m: float = Field(default=0.0005, gt=0.0)
    settled_rad: float = Field(default=0.0001, gt=0.0)

    inlier_m: float = Field(default=0.10, gt=0.0)
    lost_share: float = Field(default=0.30, ge=0.0, le=1.0)
    # Enough where wheels were measured, and the match is no farther from them than so many sigmas.
    weak_share: float = Field(default=0.15, ge=0.0, le=1.0)
    weak_sigmas: float = Field(default=2.0, ge=0.0)
    degraded_share: float = Field(default=0.45, ge=0.0, le=1.0)
    degraded_sigma_m: float = Field(default=0.10, gt=0.0)
    least_points: int = Field(default=20, ge=3)


@dataclass(frozen=True, slots=True, eq=False)
class _Attempt:
    """A scan that is to be laid on a map."""

    points: Points
    normals: npt.NDArray[np.float64]  # (N, 3) from estimate_normals
    predicted: Prediction
    prior: Prior


@dataclass(frozen=True, slots=True, eq=False)
class _Laid:
    """Where it ended on one sub-map."""

    result: MatchResult
    xy_base: npt.NDArray[np.float64]  # (N, 2) m, deskewed with the twist found
    submap: Submap


class SurfelGaussNewton:
    """Matcher[SurfelSubmaps]."""

    def __init__(self, config: SurfelMatcherConfig) -> None:
        self._config = config
        self._settings = MatchSettings(
            0.01,
            config.wall_sigma_m,
            1.0,
            config.cauchy_m,
            config.least_normal_cosine,
            config.iterations,
            config.deskew_rounds,
            config.inlier_m,
            config.coarse_sigma,
            config.coarse_beams,
            config.coarse_iterations,
            config.settled_m,
            config.settled_rad,
        )
        self._usual_share = 1.0
        self._rest_until_ns = 0  # no wide search before

    def match(self, points: Points, predicted: Prediction, local_map: SurfelSubmaps) -> Match:
        count = len(points.xy_base)
        if count < self._config.least_points:
            return Match(predicted, points, 0.0, "lost", self._too_few(points))
        if not local_map.candidates:
            return Match(predicted, points, 1.0)
        attempt = _Attempt(points, local_map.normals_of(points), predicted, _as_prior(predicted))
        laid = [self._lay(attempt, attempt.prior.pose, local_map.candidates[0])]
        for submap in local_map.candidates[1:]:
            if self._fits(laid[-1], attempt):
                break
            laid.append(self._lay(attempt, attempt.prior.pose, submap))
        best = laid[-1] if self._fits(laid[-1], attempt) else laid[0]
        if best is laid[0]:
            best = self._searched(best, attempt)
        return self._as_match(best, attempt, is_new=best is laid[-1] and len(laid) > 1)

    def _as_match(self, laid: _Laid, attempt: _Attempt, is_new: bool) -> Match:
        result, points = laid.result, attempt.points
        state, reason = self._judge(result, attempt)
        if state == "lost":
            return Match(attempt.predicted, points, result.share, state, reason)
        self._usual_share += (result.share - self._usual_share) / self._config.usual_share_scans
        x_m, y_m, theta_rad = result.pose.tolist()
        forward, left, turn = result.twist.tolist()
        pose = SE2(x_m, y_m, theta_rad)
        measured = Measurement(pose, result.covariance, result.information, result.prior_weight)
        motion = Motion(pose, (forward, left, turn), result.covariance)
        deskewed = replace(points, xy_base=laid.xy_base)
        return Match(motion, deskewed, result.share, state, reason, laid.submap.number, measured)

    def _lay(self, attempt: _Attempt, start: npt.NDArray[np.float64], submap: Submap) -> _Laid:
        """The match on a sub-map, begun at `start`, a pose as in the prior."""
        points = attempt.points
        xy_base = points.xy_base.copy()
        result: MatchResult = match_scan(
            Returns(points.xy_raw, points.beam_time_s, points.beam),
            submap.weighed(points, attempt.normals, start),
            attempt.prior,
            start,
            submap.grid(),
            self._settings._replace(
                range_sigma_m=points.range_sigma_m,
                repeats=self._repeats(attempt.predicted),
            ),
            self._config.doubt_ratio * self._usual_share,
            xy_base,
        )
        return _Laid(result, xy_base, submap)

    def _repeats(self, predicted: Prediction) -> float:
        """How many scans in a row see the same errors of the map."""
        apart_m = max(predicted.travel_m, self._config.same_wall_m / self._config.most_repeats)
        return max(1.0, self._config.same_wall_m / apart_m)

    def _fits(self, laid: _Laid, attempt: _Attempt) -> bool:
        return self._judge(laid.result, attempt)[0] != "lost"

    def _searched(self, laid: _Laid, attempt: _Attempt) -> _Laid:
        """The best pose around the prediction, if clearly more of the scan lies on the map there.

        A poor recovery is worse than none: a prediction that goes on is found again, a jump is not.
        """
        config, prior = self._config, attempt.prior
        share = laid.result.share
        reach_m, reach_rad = config.search_most_m, config.search_most_rad
        if share >= (config.degraded_share if attempt.predicted.is_measured else config.lost_share):
            if attempt.predicted.is_measured or share >= config.doubt_ratio * self._usual_share:
                return laid
            sigma_m, sigma_rad = (math.sqrt(prior.covariance[k, k]) for k in (0, 2))
            reach_m = min(max(3.0 * sigma_m, config.search_least_m), reach_m)
            reach_rad = min(max(3.0 * sigma_rad, config.search_least_rad), reach_rad)
        elif attempt.points.scan.stamp_ns < self._rest_until_ns:
            return laid
        else:
            self._rest_until_ns = attempt.points.scan.stamp_ns + round(config.search_rest_s * 1e9)
        start = search_around(attempt.points.xy_base, prior.pose, reach_m, reach_rad, laid.submap.grid())
        if start is None:
            return laid
        found = self._lay(attempt, start, laid.submap)
        least = share + config.search_gain
        if self._sigmas_away(found.result, prior) > config.jump_sigmas:
            least = max(least, config.degraded_share)
        return found if found.result.share >= least else laid

    def _is_confirmed(self, result: MatchResult, attempt: _Attempt) -> bool:
        """Whether wheels vouch for a match of few points: a turn through a door shows mostly new walls."""
        return (
            attempt.predicted.is_measured
            and result.share >= self._config.weak_share
            and self._sigmas_away(result, attempt.prior) <= self._config.weak_sigmas
        )

    def _sigmas_away(self, result: MatchResult, prior: Prior) -> float:
        """How far a match is from the prediction."""
        away = SE2(*prior.pose.tolist()).inverse() @ SE2(*result.pose.tolist())
        offset = np.array([away.x_m, away.y_m, away.theta_rad])
        return float(np.sqrt(offset @ np.linalg.solve(prior.covariance, offset)))

    def _jump(self, result: MatchResult, predicted: Prediction, prior: Prior) -> str | None:
        """Why a match is not believed that fits worse than usual and needs a speed that nothing can reach.

        Someone close before the laser leaves few walls and a minimum elsewhere. A pose that is a little wrong
        comes back with the next scan, a jump does not. Wheels may be wrong, so the walls overrule them.
        """
        is_guess = predicted.elapsed_s > 0.0 and not predicted.is_measured
        if not is_guess or result.share >= self._config.doubt_ratio * self._usual_share:
            return None
        if self._sigmas_away(result, prior) <= self._config.jump_sigmas:
            return None
        away = predicted.pose_odom_base.inverse() @ SE2(*result.pose.tolist())
        return (
            f"{result.share:.0%} of {result.used} returns lie on the map (usual {self._usual_share:.0%}), "
            f"{math.hypot(away.x_m, away.y_m):.2f} m and {abs(away.theta_rad):.2f} rad from the prediction; "
            "the pose follows the prediction"
        )

    def _judge(self, result: MatchResult, attempt: _Attempt) -> tuple[State, str]:
        config = self._config
        if result.share < config.lost_share:
            on_map = f"{result.share:.0%} of {result.used} returns lie on the map"
            if self._is_confirmed(result, attempt):
                return "degraded", f"{on_map} (at least {config.lost_share:.0%}), but the wheels say the same"
            return "lost", f"{on_map} (at least {config.lost_share:.0%}); the pose follows the prediction"
        if (jump := self._jump(result, attempt.predicted, attempt.prior)) is not None:
            return "lost", jump
        if result.share < config.degraded_share:
            return "degraded", (
                f"{result.share:.0%} of {result.used} returns lie on the map "
                f"(expected {config.degraded_share:.0%}): much has changed, or the prediction was far off"
            )
        if result.weakest_sigma_m > config.degraded_sigma_m:
            towards_deg = math.degrees(result.weakest_direction_rad) % 180.0
            return "degraded", (
                f"the walls in view do not fix the position along {towards_deg:.0f} deg of the vehicle "
                f"(sigma {result.weakest_sigma_m:.2f} m); the prediction holds it"
            )
        return "ok", ""

    def _too_few(self, points: Points) -> str:
        return (
            f"{points.scan.sensor}: {len(points.xy_base)} of {len(points.scan.range_m)} beams returned "
            f"(at least {self._config.least_points}); is the window covered, or is there nothing in range?"
        )


def _as_prior(predicted: Prediction) -> Prior:
    pose = predicted.pose_odom_base
    return Prior(
        np.array([pose.x_m, pose.y_m, pose.theta_rad]),
        np.array(predicted.twist_base),
        predicted.local_covariance,
        predicted.twist_gain,
    )
