"""The matcher of the default profile: Gauss-Newton on surfels, with a coarse map to fall back on."""

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from service.fusion.motion import Matched, Motion, Prediction
from service.geometry.se2 import SE2
from service.kernels.deskew import Returns
from service.kernels.drift import match_information
from service.kernels.match import MatchResult, MatchSettings, Prior, match_scan
from service.mapper.maps.submaps import Submap, SurfelSubmaps
from service.mapper.matchers.recovery import search_around
from service.mapper.stages import Match, Points
from service.outputs import State


class SurfelMatcherConfig(BaseModel):
    """How a scan is laid on the sub-map, and when the result is believed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    beam_sigma_m: float = Field(default=0.05, gt=0.0)
    cauchy_m: float = Field(default=0.10, gt=0.0)
    least_normal_cosine: float = Field(default=0.6, ge=-1.0, lt=1.0)
    young_count: float = Field(default=3.0, ge=1.0)
    iterations: int = Field(default=15, ge=1, le=100)
    deskew_rounds: int = Field(default=8, ge=0, le=100)
    coarse_sigma: float = Field(default=0.3, gt=0.0)  # of 1 - likelihood
    coarse_beams: int = Field(default=180, ge=10)
    coarse_iterations: int = Field(default=15, ge=0, le=100)

    jump_sigmas: float = Field(default=4.0, gt=0.0)  # from the prediction: then a doubtful match is refused
    doubt_ratio: float = Field(default=0.9, ge=0.0, le=1.0)  # of the usual share on the map
    search_least_m: float = Field(
        default=0.3, gt=0.0
    )  # window of the search when too little lies on the map:
    search_most_m: float = Field(default=2.0, gt=0.0)  # three sigmas of the prediction, within these
    search_least_rad: float = Field(default=0.2, gt=0.0)
    search_most_rad: float = Field(default=1.6, gt=0.0)
    search_gain: float = Field(default=0.08, ge=0.0)  # so much more must then lie on the map
    usual_share_scans: int = Field(default=50, ge=1)  # over which the usual share is taken
    settled_m: float = Field(default=0.0005, gt=0.0)
    settled_rad: float = Field(default=0.0001, gt=0.0)

    inlier_m: float = Field(default=0.10, gt=0.0)
    lost_share: float = Field(default=0.30, ge=0.0, le=1.0)
    degraded_share: float = Field(default=0.45, ge=0.0, le=1.0)
    blind_sigma_m: float = Field(default=0.05, gt=0.0)  # directions known less well keep to the wheels
    degraded_sigma_m: float = Field(default=0.10, gt=0.0)
    least_points: int = Field(default=20, ge=3)

    covariance_scale: float = Field(default=2.0, gt=0.0)
    inflation: float = Field(default=4.0, gt=0.0)  # beams share errors, so as many count as one
    least_residual_m: float = Field(default=0.005, gt=0.0)
    floor_position_m: float = Field(default=0.002, ge=0.0)
    floor_heading_rad: float = Field(default=0.0003, ge=0.0)


class SurfelGaussNewton:
    """Matcher[SurfelSubmaps]."""

    def __init__(self, config: SurfelMatcherConfig) -> None:
        self._config = config
        self._settings = MatchSettings(
            config.beam_sigma_m,
            config.cauchy_m,
            config.least_normal_cosine,
            config.young_count,
            config.iterations,
            config.deskew_rounds,
            config.inlier_m,
            config.coarse_sigma,
            config.coarse_beams,
            config.coarse_iterations,
            config.settled_m,
            config.settled_rad,
            config.blind_sigma_m,
            config.covariance_scale,
        )
        self._usual_share = 1.0
        self._floor = np.diag(
            [config.floor_position_m**2, config.floor_position_m**2, config.floor_heading_rad**2]
        )

    def match(self, points: Points, predicted: Prediction, local_map: SurfelSubmaps) -> Match:
        count = len(points.xy_base)
        if count < self._config.least_points:
            return Match(_as_motion(predicted), points, 0.0, "lost", self._too_few(points))
        if not local_map.candidates:
            first = Matched(
                predicted.pose_odom_base, predicted.twist_base, self._floor, np.linalg.inv(self._floor)
            )
            return Match(first, points, 1.0)
        normals = local_map.normals_of(points)
        matches = (
            self._match_to(submap, points, normals, predicted, is_new=k > 0)
            for k, submap in enumerate(local_map.candidates)
        )
        best = next(matches)
        for match in matches:
            if best.state != "lost":
                break
            best = match
        return best

    def _match_to(
        self,
        submap: Submap,
        points: Points,
        normals: npt.NDArray[np.float64],
        predicted: Prediction,
        is_new: bool,
    ) -> Match:
        pose = predicted.pose_odom_base
        prior = Prior(
            np.array([pose.x_m, pose.y_m, pose.theta_rad]),
            np.array(predicted.twist_base),
            predicted.step_covariance,
            predicted.covariance,
            predicted.elapsed_s,
            predicted.twist_gain,
            predicted.is_measured,
        )
        result, xy_base = self._lay(points, normals, prior, submap)
        if result.share < self._least_share(predicted):
            result, xy_base = self._recovered(result, xy_base, points, normals, prior, submap)
        state, reason = self._judge(result)
        if state != "lost" and (jump := self._jump(result, predicted)) is not None:
            state, reason = "lost", jump
        if state == "lost":
            return Match(_as_motion(predicted), points, result.share, state, reason)
        self._usual_share += (result.share - self._usual_share) / self._config.usual_share_scans
        x_m, y_m, theta_rad = result.pose.tolist()
        forward, left, turn = result.twist.tolist()
        motion = Matched(
            SE2(x_m, y_m, theta_rad),
            (forward, left, turn),
            self._floored(result.covariance),
            self._information(result),
            on_new_map=is_new,
        )
        deskewed = replace(points, xy_base=xy_base)
        return Match(motion, deskewed, result.share, state, reason, submap.number)

    def _lay(
        self, points: Points, normals: npt.NDArray[np.float64], prior: Prior, submap: Submap
    ) -> tuple[MatchResult, npt.NDArray[np.float64]]:
        """The match, and the points deskewed with what it found."""
        xy_base = points.xy_base.copy()
        result: MatchResult = match_scan(
            Returns(points.xy_raw, points.beam_time_s, points.beam),
            normals,
            prior,
            submap.grid(),
            self._settings,
            self._config.doubt_ratio * self._usual_share,
            xy_base,
        )
        return result, xy_base

    def _least_share(self, predicted: Prediction) -> float:
        """With less on the map, the surroundings are searched: wheels are seldom so wrong as a guess."""
        if predicted.is_measured:
            return self._config.lost_share
        return self._config.doubt_ratio * self._usual_share

    def _recovered(
        self,
        result: MatchResult,
        xy_base: npt.NDArray[np.float64],
        points: Points,
        normals: npt.NDArray[np.float64],
        prior: Prior,
        submap: Submap,
    ) -> tuple[MatchResult, npt.NDArray[np.float64]]:
        """The best pose near the prediction, if clearly more of the scan lies on the map there.

        A poor recovery is worse than none: a prediction that goes on is found again, a jump is not.
        """
        config = self._config
        sigma_m, sigma_rad = (math.sqrt(prior.step_covariance[k, k]) for k in (0, 2))
        reach_m = min(max(3.0 * sigma_m, config.search_least_m), config.search_most_m)
        reach_rad = min(max(3.0 * sigma_rad, config.search_least_rad), config.search_most_rad)
        start = search_around(points.xy_base, prior.pose, reach_m, reach_rad, submap.grid())
        if start is None:
            return result, xy_base
        found, found_xy_base = self._lay(points, normals, prior._replace(pose=start), submap)
        if found.share < result.share + config.search_gain:
            return result, xy_base
        return found, found_xy_base

    def _jump(self, result: MatchResult, predicted: Prediction) -> str | None:
        """Why a match is not believed that fits worse than usual and needs a speed that nothing can reach.

        Someone close before the laser leaves few walls and a minimum elsewhere. A pose that is a little wrong
        comes back with the next scan, a jump does not. Wheels may be wrong, so the walls overrule them.
        """
        is_guess = predicted.elapsed_s > 0.0 and not predicted.is_measured
        if not is_guess or result.share >= self._config.doubt_ratio * self._usual_share:
            return None
        pose = predicted.pose_odom_base
        away = pose.inverse() @ SE2(*result.pose.tolist())
        offset = np.array([away.x_m, away.y_m, away.theta_rad])
        sigmas = float(np.sqrt(offset @ np.linalg.solve(predicted.step_covariance, offset)))
        if sigmas <= self._config.jump_sigmas:
            return None
        return (
            f"{result.share:.0%} of {result.used} returns lie on the map (usual {self._usual_share:.0%}), "
            f"{math.hypot(away.x_m, away.y_m):.2f} m and {abs(away.theta_rad):.2f} rad from the prediction; "
            "the pose follows the prediction"
        )

    def _judge(self, result: MatchResult) -> tuple[State, str]:
        config = self._config
        if result.share < config.lost_share:
            return "lost", (
                f"{result.share:.0%} of {result.used} returns lie on the map "
                f"(at least {config.lost_share:.0%}); the pose follows the prediction"
            )
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

    def _information(self, result: MatchResult) -> npt.NDArray[np.float64]:
        """(3, 3) what the points say of the pose on the map, by how far off they lie."""
        config = self._config
        residual_m = max(result.residual_m, config.least_residual_m)
        information = np.empty((3, 3))
        match_information(
            result.information,
            (config.beam_sigma_m / residual_m) ** 2 / config.inflation,
            np.diag(self._floor).copy(),
            information,
        )
        return information

    def _floored(self, covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Raised where it claims to know better than the map can say; raising it again changes nothing."""
        short = np.maximum(np.diag(self._floor) - np.diag(covariance), 0.0)
        raised: npt.NDArray[np.float64] = covariance + np.diag(short)
        return raised


def _as_motion(predicted: Prediction) -> Motion:
    return Motion(predicted.pose_odom_base, predicted.twist_base, predicted.covariance)
