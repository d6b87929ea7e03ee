"""Monte Carlo search on the likelihood map as in tinySLAM, as a reference for the exhaustive search."""

import numpy as np
from pydantic import Field

from service.estimator.motion import Measurement, Prediction
from service.geometry.poses import moved_by
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.line_likelihood import monte_carlo_search
from service.mapper.components import Match, Points
from service.mapper.judgement import JudgementConfig, begun, too_few, unmatched
from service.mapper.matchers.covariances import diagonal, inverse
from service.mapper.matchers.judged import Aligned, judged_alone
from service.mapper.papers.imle.patch_map import PatchMap
from service.mapper.papers.imle.scan_icp import deskewed


class MonteCarloConfig(JudgementConfig):
    """Size and number of the trials."""

    sigma_m: float = Field(default=0.1, gt=0.0)  # of the first trials
    sigma_rad: float = Field(default=0.349, gt=0.0)  # 20 deg
    trials: int = Field(default=1000, ge=10)  # without success before it ends
    seed: int = Field(default=1, ge=0)
    position_sigma_m: float = Field(default=0.05, gt=0.0)  # reported
    heading_sigma_rad: float = Field(default=0.02, gt=0.0)


class MonteCarloSearch:
    """Matcher[PatchMap]. Random numbers come from the configured seed only."""

    def __init__(self, config: MonteCarloConfig) -> None:
        self._config = config
        self._noise = np.random.default_rng(config.seed)
        self._covariance = diagonal(config.position_sigma_m, config.heading_sigma_rad)
        self._information = inverse(self._covariance)

    def match(self, points: Points, predicted: Prediction, local_map: PatchMap) -> Match:
        config = self._config
        if reason := too_few(points):
            return unmatched(points, predicted, reason)
        if local_map.is_empty:
            return begun(points, predicted)
        begin = predicted.pose_odom_base
        local_map.prepare(moved_by(begin, points.xy_base), min(1.0, local_map.config.patch_m / 2))
        layer = local_map.fine
        found, _, _ = monte_carlo_search(
            points.xy_base,
            layer,
            np.array(begin),
            self._noise.standard_normal((3 * config.trials, 3)),
            config.sigma_m,
            config.sigma_rad,
        )
        x_m, y_m, theta_rad = found.tolist()
        pose = SE2(x_m, y_m, wrap_angle(theta_rad))
        aligned = Aligned(
            Measurement(pose, self._covariance, self._information, is_joined=False),
            deskewed(points, predicted, pose),
        )
        on_map = local_map.overlap(aligned.points.xy_base, pose).on_map
        return judged_alone(aligned, predicted, on_map, config)

    compare = match  # stateless
