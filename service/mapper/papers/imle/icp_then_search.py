"""ICP gives a coarse pose, an exhaustive search of the likelihood map the final one."""

import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from service.estimator.motion import Measurement, Prediction
from service.geometry.poses import moved_by
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.likelihood_search import (
    LikelihoodLayer,
    SearchResult,
    SearchWindow,
    search_exhaustive,
    surface_moments,
)
from service.mapper.components import Match, Points
from service.mapper.judgement import JudgementConfig, too_few
from service.mapper.matchers.covariances import diagonal, in_base_axes, inverse
from service.mapper.matchers.judged import Aligned, JudgedMatching
from service.mapper.matchers.window_search import search_around, search_bounded, step_of, window_around
from service.mapper.papers.imle.patch_map import PatchMap
from service.mapper.papers.imle.scan_icp import IcpConfig, ScanIcp, deskewed

Array = npt.NDArray[np.float64]
Sums = npt.NDArray[np.float32]

HEADING_STEPS_BETWEEN = 5  # refinement divides a heading step by this
REFINE_CELLS = 3


class IcpThenSearchConfig(JudgementConfig):
    """Size of the search around the result of ICP, and when the result is accepted."""

    icp: IcpConfig = IcpConfig()
    window_rms: float = Field(default=3.0, gt=0.0)  # half a window over the rms error of ICP,
    least_window_m: float = Field(default=0.05, gt=0.0)  # at least this
    most_window_m: float = Field(default=0.5, gt=0.0)  # and at most this
    window_rad: float = Field(default=0.349, gt=0.0)  # to each side: 20 deg
    step_rad: float = Field(default=0.00873, gt=0.0)  # 0.5 deg
    search: Literal["narrowing", "exhaustive"] = "narrowing"
    narrow_cells: int = Field(default=2, ge=1)  # coarse cells around the coarse maximum, and
    narrow_steps: int = Field(default=2, ge=1)  # heading steps, searched on the fine layer
    refine: bool = True  # between the cells and steps
    refine_scale: float = Field(default=3.0, gt=0.0)  # number of beams with a common error

    covariance_scale: float = Field(default=10.0, gt=0.0)
    floor_position_m: float = Field(default=0.005, gt=0.0)
    floor_heading_rad: float = Field(default=0.001, gt=0.0)


class IcpThenSearch:
    """Matcher[PatchMap]."""

    def __init__(self, config: IcpThenSearchConfig) -> None:
        self._config = config
        self._icp = ScanIcp(config.icp)
        self._matching = JudgedMatching(config)
        self._floor = diagonal(config.floor_position_m, config.floor_heading_rad)
        self.evaluated = 0  # candidates of the last scan, over all searches
        self.window_m = 0.0  # half the window of the last scan

    def match(self, points: Points, predicted: Prediction, local_map: PatchMap) -> Match:
        match = self._matching.match(points, predicted, local_map, self)
        if not too_few(points):
            self._icp.remember(match)
        return match

    compare = match  # its state is independent of the laser

    def align(
        self, points: Points, predicted: Prediction, local_map: PatchMap, is_found: bool = False
    ) -> Aligned:
        """Align by ICP and search; after a relocalisation without ICP, as the previous scan was elsewhere."""
        config = self._config
        begin, rms_m = predicted.pose_odom_base, 0.0
        if not is_found:
            step = self._icp.step(points, predicted)
            begin, rms_m = (begin, math.inf) if step is None else (step.pose, step.rms_m)
        local_map.prepare(
            moved_by(begin, points.xy_base), min(2.0 * config.most_window_m, local_map.config.patch_m / 2)
        )
        fine, coarse = local_map.fine, local_map.coarse
        self.window_m = min(max(config.window_rms * rms_m, config.least_window_m), config.most_window_m)
        self.evaluated = 0
        if config.search == "narrowing":
            start = self._widening(points.xy_base, coarse, begin)
            half = config.narrow_cells * local_map.config.coarse_cells
            best, covariance = self._around(points.xy_base, fine, start.pose, half)
            if _widest(covariance) > half * fine.cell_m / 2:  # the narrow window truncates the distribution
                half = math.ceil(self.window_m / coarse.cell_m)
                _, covariance = self._around(points.xy_base, coarse, start.pose, half)
        else:
            best = self._widening(points.xy_base, fine, begin)
            half = math.ceil(self.window_m / fine.cell_m)
            _, covariance = self._around(points.xy_base, fine, best.pose, half)
        pose = self._refined(points.xy_base, fine, best) if config.refine else best.pose

        x_m, y_m, theta_rad = pose.tolist()
        covariance = in_base_axes(covariance, theta_rad) + self._floor
        information = inverse(covariance)
        measured = Measurement(SE2(x_m, y_m, wrap_angle(theta_rad)), covariance, information, is_joined=False)
        return Aligned(measured, deskewed(points, predicted, measured.pose_odom_base))

    def search(
        self, points: Points, local_map: PatchMap, pose: SE2, reach: tuple[float, float]
    ) -> SE2 | None:
        local_map.prepare(moved_by(pose, points.xy_base), min(reach[0], local_map.config.patch_m / 2))
        return search_around(points.xy_base, pose, reach, local_map.coarse, step_of(reach))

    def _widening(self, xy_base: Array, layer: LikelihoodLayer, begin: SE2) -> SearchResult:
        """Search the window, doubled while the best candidate lies on its border."""
        config = self._config
        pose = np.array(begin)
        while True:
            window = window_around(pose, (self.window_m, config.window_rad), layer, config.step_rad)
            if config.search == "narrowing":
                best = search_bounded(xy_base, layer, window)
                self.evaluated += best.evaluated
            else:
                best, _ = self._evaluate(xy_base, layer, window)
            on_border = best.i in (0, 2 * window.half_x) or best.j in (0, 2 * window.half_y)
            if not on_border or self.window_m >= config.most_window_m:
                return best
            self.window_m = min(2.0 * self.window_m, config.most_window_m)

    def _around(
        self, xy_base: Array, layer: LikelihoodLayer, pose: Array, half: int
    ) -> tuple[SearchResult, Array]:
        """The best within `half` cells and narrow_steps of a pose, and its covariance."""
        config = self._config
        window = SearchWindow(pose, half, half, config.narrow_steps, config.step_rad)
        best, sums = self._evaluate(xy_base, layer, window)
        return best, self._covariance(best, sums, window, layer)

    def _evaluate(
        self, xy_base: Array, layer: LikelihoodLayer, window: SearchWindow
    ) -> tuple[SearchResult, Sums]:
        best, sums = search_exhaustive(xy_base, layer, window)
        self.evaluated += best.evaluated
        return best, sums

    def _refined(self, xy_base: Array, layer: LikelihoodLayer, best: SearchResult) -> Array:
        """Sub-cell pose: the likelihood-weighted mean of the candidates around the best."""
        step_rad = self._config.step_rad / HEADING_STEPS_BETWEEN
        window = SearchWindow(best.pose, REFINE_CELLS, REFINE_CELLS, HEADING_STEPS_BETWEEN, step_rad)
        best, sums = self._evaluate(xy_base, layer, window)
        top = float(sums[best.k, best.j, best.i])
        mean, _ = surface_moments(sums, top, self._config.refine_scale / layer.scale)
        middle = np.array([window.half_x, window.half_y, window.half_theta])
        pose: Array = window.pose + np.array([layer.cell_m, layer.cell_m, step_rad]) * (mean - middle)
        return pose

    def _covariance(
        self, best: SearchResult, sums: Sums, window: SearchWindow, layer: LikelihoodLayer
    ) -> Array:
        """(3, 3) of x, y, theta in the frame of the map, from the candidates around the best."""
        top = float(sums[best.k, best.j, best.i])
        _, moments = surface_moments(sums, top, self._config.covariance_scale / layer.scale)
        steps = np.array([layer.cell_m, layer.cell_m, window.theta_step_rad])
        covariance: Array = moments * np.outer(steps, steps)
        return covariance


def _widest(covariance: Array) -> float:
    """The largest sigma of the position, m."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]), 0.0))
