"""Brute search down a pyramid of likelihood maps, then gradient ascent between the cells of the finest."""

import math

import numpy as np
import numpy.typing as npt
from pydantic import Field

from service.estimator.motion import Measurement, Prediction
from service.geometry.poses import moved_by
from service.geometry.se2 import SE2
from service.kernels.likelihood_lm import thin_evenly
from service.kernels.likelihood_search import LikelihoodLayer, search_exhaustive
from service.mapper.components import Match, Points
from service.mapper.judgement import JudgementConfig
from service.mapper.matchers.covariances import diagonal, in_base_axes, inverse
from service.mapper.matchers.field_align import align, values_at
from service.mapper.matchers.judged import Aligned, JudgedMatching
from service.mapper.matchers.window_search import search_around, step_of, window_around
from service.mapper.papers.owolm_eskf.across_walls import information_across, information_of_dots
from service.mapper.papers.owolm_eskf.orthogonal_map import OrthogonalMap

Array = npt.NDArray[np.float64]

BLIND = np.diag([1e-4, 1e-4, 0.1])  # least information: sigma of 100 m and 3 rad
RECOVERY_CELL_M = 0.1  # a lost scan is searched for on the first level with cells at least this wide


class BruteSearchConfig(JudgementConfig):
    """Size of the search around the prediction, and when the result is accepted."""

    least_window_m: float = Field(default=0.2, gt=0.0)  # half window: window_sigmas of the prediction,
    most_window_m: float = Field(default=1.0, gt=0.0)  # within these limits
    least_window_rad: float = Field(default=0.035, gt=0.0)
    most_window_rad: float = Field(default=0.35, gt=0.0)
    window_sigmas: float = Field(default=3.0, gt=0.0)
    beams: int = Field(default=360, ge=20)  # used in the search, evenly chosen
    refine_iterations: int = Field(default=15, ge=0, le=100)  # 0: the best cell is the result
    residual_sigma: float = Field(default=0.3, gt=0.0)  # of 1 - likelihood
    covariance_scale: float = Field(default=30.0, gt=0.0)
    floor_position_m: float = Field(default=0.01, gt=0.0)
    floor_heading_rad: float = Field(default=0.001, gt=0.0)


class BruteSearch:
    """Matcher[OrthogonalMap]. Measures by the scan alone; the motion model fuses the prediction."""

    def __init__(self, config: BruteSearchConfig) -> None:
        self._config = config
        self._matching = JudgedMatching(config)
        self._floor = diagonal(config.floor_position_m, config.floor_heading_rad)

    def match(self, points: Points, predicted: Prediction, local_map: OrthogonalMap) -> Match:
        return self._matching.match(points, predicted, local_map, self)

    compare = match  # its state is independent of the laser

    def align(
        self, points: Points, predicted: Prediction, local_map: OrthogonalMap, is_found: bool = False
    ) -> Aligned:
        config = self._config
        window_m, window_rad = self._window(predicted)
        begin = local_map.pose_axes_odom @ predicted.pose_odom_base
        pose = np.array(begin)
        thin, weights = thin_evenly(points.xy_base, config.beams, config.residual_sigma)
        pose, steps = self._search(thin, pose, local_map, window_m, window_rad)
        field = local_map.field()
        prior = pose, np.diag(1.0 / np.square(steps))
        pose = align(thin, weights, prior, field, pose, config.refine_iterations)
        x_m, y_m, theta_rad = pose.tolist()
        aligned = SE2(x_m, y_m, theta_rad)
        every, weights = thin_evenly(points.xy_base, len(points.xy_base), config.residual_sigma)
        segment = local_map.segments(moved_by(aligned, points.xy_base), local_map.gaps(points))
        values = values_at(every, pose, field)
        across = information_across(points, values, weights, segment, pose)
        sure = covariance = self._covariance(across, BLIND, theta_rad)
        if not predicted.is_confirmed:  # a single motion source may be wrong: isolated points count, too
            point_information = information_of_dots(points, values, weights, segment, pose)
            least = np.diag(1.0 / np.square([window_m, window_m, window_rad]))
            covariance = self._covariance(point_information, least, theta_rad)
        matched = local_map.pose_axes_odom.between(aligned)
        information = inverse(covariance if is_found else sure)
        return Aligned(Measurement(matched, covariance, information, is_joined=False), points)

    def search(
        self, points: Points, local_map: OrthogonalMap, pose: SE2, reach: tuple[float, float]
    ) -> SE2 | None:
        layers = local_map.search_layers()
        layer = next((layer for layer in layers if layer.cell_m >= RECOVERY_CELL_M), layers[-1])
        found = search_around(points.xy_base, local_map.pose_axes_odom @ pose, reach, layer, step_of(reach))
        return None if found is None else local_map.pose_axes_odom.between(found)

    def _search(
        self, xy_base: Array, pose: Array, local_map: OrthogonalMap, window_m: float, window_rad: float
    ) -> tuple[Array, Array]:
        """Best cell of the finest level, and the step between candidates there (m, m, rad).

        Levels with cells wider than the window are skipped. The next window is a cell and a heading step of
        the level before, to each side.
        """
        reach_m = max(float(np.percentile(np.hypot(xy_base[:, 0], xy_base[:, 1]), 80.0)), 1.0)
        layers: list[LikelihoodLayer] = local_map.search_layers()
        while len(layers) > 1 and layers[-1].cell_m > window_m:
            layers.pop()
        step_rad = window_rad
        for layer in reversed(layers):
            step_rad = min(layer.cell_m / reach_m, window_rad)
            window = window_around(pose, (window_m, window_rad), layer, step_rad)
            pose = search_exhaustive(xy_base, layer, window)[0].pose
            window_m, window_rad = layer.cell_m, step_rad
        return pose, np.array([window_m, window_m, step_rad])

    def _window(self, predicted: Prediction) -> tuple[float, float]:
        config = self._config
        variances = np.diag(predicted.local_covariance)
        position_m = config.window_sigmas * math.sqrt(float(variances[:2].max()))
        heading_rad = config.window_sigmas * math.sqrt(float(variances[2]))
        return (
            min(max(position_m, config.least_window_m), config.most_window_m),
            min(max(heading_rad, config.least_window_rad), config.most_window_rad),
        )

    def _covariance(self, point_information: Array, least: Array, theta_rad: float) -> Array:
        """(3, 3) of x, y, theta in base axes, from the information of the points and a least information."""
        information = point_information / self._config.covariance_scale + least
        return in_base_axes(inverse(information), theta_rad) + self._floor
