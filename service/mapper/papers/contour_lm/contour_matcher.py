"""Brute search on the coarsest level, then Levenberg-Marquardt down the pyramid with the velocity."""

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.section import Section
from service.estimator.motion import Measurement, Prediction
from service.geometry.se2 import SE2
from service.kernels.deskew import Returns, deskew_points
from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_lm import LmSettings, likelihood_normal_equations
from service.kernels.likelihood_search import SearchWindow, search_exhaustive
from service.kernels.pose_information import rotate_information
from service.kernels.robust_normals import balance_weights, estimate_orientations
from service.kernels.velocity_lm import align_level
from service.mapper.components import Match, Points
from service.mapper.judgement import JudgementConfig
from service.mapper.matchers.covariances import diagonal, inverse
from service.mapper.matchers.field_align import values_at
from service.mapper.matchers.judged import Aligned, JudgedMatching
from service.mapper.matchers.window_search import search_around, step_of, thinned
from service.mapper.papers.contour_lm.contour_map import ContourMap

Array = npt.NDArray[np.float64]
PRINTED_BEAMS = 540
MAX_TRIALS, MAX_DAMPING, DAMPED_FLOOR = 100, 1e6, 1e-9  # of one step; without a prior only these end it


class WeightsConfig(Section):
    """Weights of points that balance the orientations of walls (eq. 9)."""

    bins: int = Field(default=12, ge=1, le=180)  # B, over 180 deg
    middle_count: float = Field(default=100.0, gt=0.0)  # of 540 beams; scaled to the sensor's
    slope_count: float = Field(default=50.0, gt=0.0)
    beams_each_side: int = Field(default=4, ge=1, le=10)  # neighbours for a normal
    half_length_m: float = Field(default=0.15, ge=0.0, le=1.0)  # ... or more within this distance
    # Neighbours with less scatter need no robust estimate.
    thin_m: float = Field(default=0.02, ge=0.0)


class SearchConfig(Section):
    """The coarse search before the alignment: a window in sigmas of the prediction, within limits."""

    window_sigmas: float = Field(default=2.0, ge=0.0)
    most_window_m: float = Field(default=0.5, ge=0.0)
    most_window_rad: float = Field(default=0.35, ge=0.0)
    step_rad: float = Field(default=0.04, gt=0.0)
    beams: int = Field(default=90, ge=10)  # used, evenly chosen
    least_gain: float = Field(default=0.05, ge=0.0)  # least increase of the likelihood over the prediction


class ContourLmConfig(JudgementConfig):
    """How a scan is aligned with the learned map, and when the result is accepted."""

    weights: WeightsConfig = WeightsConfig()
    search: SearchConfig = SearchConfig()
    iterations: int = Field(default=20, ge=1, le=200)  # I_max, on each level
    settled_m: float = Field(default=0.0005, gt=0.0)  # epsilon
    settled_rad: float = Field(default=0.0001, gt=0.0)
    first_damping: float = Field(default=1e-3, gt=0.0)
    estimate_velocity: bool = True
    beam_time: Literal["measured", "printed"] = "measured"  # printed: the period over the number of beams
    # of 1 - likelihood: weight of a point against odometry, and in the reported covariance
    residual_sigma: float = Field(default=0.6, gt=0.0)
    prior: Literal["wheels", "always", "never"] = "wheels"  # when the prediction enters the cost
    floor_position_m: float = Field(default=0.006, gt=0.0)
    floor_heading_rad: float = Field(default=0.0015, gt=0.0)


class ContourLm:
    """Matcher[ContourMap]. Without a prior in the cost the motion model fuses the prediction."""

    def __init__(self, config: ContourLmConfig) -> None:
        self._config = config
        self._matching = JudgedMatching(config)
        self._lm = LmSettings(
            MAX_TRIALS, config.settled_m, config.settled_rad, config.first_damping, MAX_DAMPING, DAMPED_FLOOR
        )
        self._floor = diagonal(config.floor_position_m, config.floor_heading_rad)

    def match(self, points: Points, predicted: Prediction, local_map: ContourMap) -> Match:
        return self._matching.match(points, predicted, local_map, self)

    compare = match  # its state is independent of the laser

    def align(
        self, points: Points, predicted: Prediction, local_map: ContourMap, is_found: bool = False
    ) -> Aligned:
        returns = Returns(points.xy_raw, self._beam_times_s(points), points.beam)
        twist = np.array(predicted.twist_base)
        xy_base = points.xy_base.copy()
        if self._config.beam_time == "printed":
            deskew_points(returns.xy_raw, returns.beam_time_s, twist, xy_base)
        normal_rad = self._normals_of(xy_base, points)
        weights = self._weights_of(normal_rad, points)
        pose = self._search(xy_base, predicted, local_map)
        hessian = self._align(returns, weights, predicted, local_map, xy_base, pose, twist)
        if not self._has_prior(predicted):
            self._across_walls(xy_base, weights, normal_rad, local_map.field(0), pose, hessian)
        covariance = self._covariance(hessian, pose[2])
        x_m, y_m, theta_rad = pose.tolist()
        measured = self._measurement(SE2(x_m, y_m, theta_rad), covariance, predicted)
        return Aligned(measured, points._replace(xy_base=xy_base))

    def search(
        self, points: Points, local_map: ContourMap, pose: SE2, reach: tuple[float, float]
    ) -> SE2 | None:
        return search_around(points.xy_base, pose, reach, local_map.search_layer(), step_of(reach))

    def _normals_of(self, xy_base: Array, points: Points) -> Array:
        """(N,) rad, base axes; NaN with too few neighbours."""
        config = self._config.weights
        angle = np.empty(len(xy_base))
        estimate_orientations(
            xy_base,
            points.sensor_xy_m,
            abs(points.scan.angle_step_rad),
            config.beams_each_side,
            config.half_length_m,
            config.thin_m,
            angle,
        )
        return angle

    def _weights_of(self, normal_rad: Array, points: Points) -> Array:
        """(N,) weight of each point, 1 in the mean."""
        config = self._config.weights
        weights = np.ones(len(normal_rad))
        scale = len(points.scan.range_m) / PRINTED_BEAMS
        histogram = np.empty(config.bins, np.int64)
        middle, slope = config.middle_count * scale, config.slope_count * scale
        balance_weights(normal_rad, middle, slope, histogram, weights)
        return weights

    def _beam_times_s(self, points: Points) -> Array:
        if self._config.beam_time == "measured":
            return points.beam_time_s
        scan = points.scan
        return np.asarray(points.beam * (scan.scan_period_ns * 1e-9 / len(scan.range_m)), np.float64)

    def _search(self, xy_base: Array, predicted: Prediction, local_map: ContourMap) -> Array:
        """Initial pose: the prediction, or a clearly more likely candidate around it."""
        config = self._config.search
        begin = predicted.pose_odom_base
        pose = np.array(begin)
        sigma = [math.sqrt(float(variance)) for variance in np.diag(predicted.local_covariance)]
        window_m = min(config.window_sigmas * max(sigma[:2]), config.most_window_m)
        window_rad = min(config.window_sigmas * sigma[2], config.most_window_rad)
        layer = local_map.search_layer()
        half_cells = round(window_m / layer.cell_m)
        half_steps = round(window_rad / config.step_rad)
        if half_cells == 0 and half_steps == 0:
            return pose
        thin = thinned(xy_base, config.beams)
        window = SearchWindow(pose, half_cells, half_cells, half_steps, config.step_rad)
        best, sums = search_exhaustive(thin, layer, window)
        here = float(sums[half_steps, half_cells, half_cells]) / len(thin)
        found: Array = best.pose
        return found if best.score > here + config.least_gain else pose

    def _align(
        self,
        returns: Returns,
        weights: Array,
        predicted: Prediction,
        local_map: ContourMap,
        xy_base: Array,
        pose: Array,
        twist: Array,
    ) -> Array:
        """Coarse to fine; changes xy_base, pose and twist. Returns the Hessian of the finest level.

        The velocity is estimated on the finest level only: an error of a coarse cell in 20 ms is metres a
        second.
        """
        config = self._config
        to = predicted.pose_odom_base
        prior_pose = np.array(to)
        information = np.zeros((3, 3))
        if self._has_prior(predicted):
            rotate_information(np.linalg.inv(predicted.local_covariance), prior_pose[2], information)
        start = to @ SE2.exp(*(-predicted.elapsed_s * rate for rate in predicted.twist_base))
        twist_gain = min(max(float(predicted.twist_gain[0, 0]) * predicted.elapsed_s, 0.0), 1.0)
        weights_of_map = 1.0 / config.residual_sigma**2 * weights
        hessian = np.zeros((3, 3))
        for number in reversed(range(local_map.level_count)):
            field = local_map.field(number)
            if number == 0:
                self._keep_likelier(xy_base, weights, field, prior_pose, pose)
            align_level(
                returns,
                weights_of_map,
                prior_pose,
                information,
                np.array(start),
                predicted.elapsed_s if number == 0 and config.estimate_velocity else 0.0,
                twist_gain,
                field,
                self._lm,
                config.iterations,
                xy_base,
                pose,
                twist,
                hessian,
            )
        return hessian

    def _has_prior(self, predicted: Prediction) -> bool:
        """Whether the prediction enters the cost."""
        prior = self._config.prior
        return predicted.elapsed_s > 0.0 and (
            prior == "always" or (prior == "wheels" and predicted.is_measured)
        )

    def _measurement(self, pose: SE2, covariance: Array, predicted: Prediction) -> Measurement:
        """covariance: (3, 3) base axes, of the scan alone."""
        information = inverse(covariance)
        if not self._has_prior(predicted):
            return Measurement(pose, covariance, information, is_joined=False)
        joined = inverse(information + inverse(predicted.local_covariance))
        return Measurement(pose, joined, information)

    def _keep_likelier(
        self, xy_base: Array, weights: Array, field: LikelihoodField, predicted: Array, pose: Array
    ) -> None:
        """Return to the prediction if the scan fits better there: coarse cells resolve only cm."""
        costs = []
        for at in (predicted, pose):
            costs.append(float(weights @ np.square(1.0 - values_at(xy_base, at, field)[:, 0])))
        if costs[0] <= costs[1]:
            pose[:] = predicted

    def _across_walls(
        self,
        xy_base: Array,
        weights: Array,
        normal_rad: Array,
        field: LikelihoodField,
        pose: Array,
        hessian: Array,
    ) -> None:
        """Recompute the Hessian (3, 3) with each point's gradient projected on its wall's normal.

        Along a wall the gradient of the map is noise of its cells. Its squares add up to information along a
        corridor that does not exist, and would outweigh the prediction.
        """
        values = values_at(xy_base, pose, field)
        angle = np.where(np.isnan(normal_rad), 0.0, normal_rad + pose[2])
        normal = np.stack((np.cos(angle), np.sin(angle)), axis=1) * ~np.isnan(normal_rad)[:, None]
        values[:, 1:] = np.sum(values[:, 1:] * normal, axis=1)[:, None] * normal
        scaled = 1.0 / self._config.residual_sigma**2 * weights
        likelihood_normal_equations(xy_base, values, scaled, pose, hessian, np.empty(3))

    def _covariance(self, hessian: Array, theta_rad: float) -> Array:
        """(3, 3) in base axes, by the gradient of the map at the points, at most about a metre."""
        information = np.empty((3, 3))
        rotate_information(hessian, -theta_rad, information)
        return inverse(information + np.eye(3)) + self._floor
