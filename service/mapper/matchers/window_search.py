"""Windows of candidate poses around a prediction on a likelihood map, searched by branch and bound."""

import math

import numpy as np

from service.geometry.poses import Floats
from service.geometry.se2 import SE2, wrap_angle
from service.kernels.branch_and_bound import MaxPyramid, build_pyramid, search_branch_and_bound
from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_search import LikelihoodLayer, SearchResult, SearchWindow, cell_bounds

MAX_LEVELS = 4  # of the pyramid: blocks of at most 8 x 8 candidates
SEARCH_BEAMS = 150  # used in a search, about
STEP_RAD = 0.02  # a cell of 10 cm at 5 m
WIDE_RAD, WIDE_STEP_RAD = 2.0, 0.04  # half width of a window, from which on headings are this far apart
MIN_INLIER_GAIN = 0.08  # least increase of the inlier ratio by a search
SEARCH_INTERVAL_S = 0.5  # between two searches of the entire window
MIN_WINDOW = (0.3, 0.2)  # m, rad: least half width of a window
MAX_WINDOW = (8.0, math.pi)  # m, rad: largest half width
LOST_WINDOW = (2.0, 1.6)  # of a scan that is lost although the prediction is certain
SAME_RESULT_M, SAME_RESULT_RAD = 0.3, 0.06  # within which two results agree


def layer_of(field: LikelihoodField) -> LikelihoodLayer:
    """A likelihood field as a layer for searches."""
    return LikelihoodLayer(field.tiles, field.field, 0.0, 0.0, 1.0, field.cell_m)


def thinned(xy: Floats, most: int) -> Floats:
    """Every k-th of the points (N, 2), so that about `most` remain."""
    return np.ascontiguousarray(xy[:: max(1, len(xy) // most)])


def window_around(
    pose: Floats, reach: tuple[float, float], layer: LikelihoodLayer | MaxPyramid, step_rad: float
) -> SearchWindow:
    """All candidates within (m, rad) of a pose (3,), in cells of a layer and steps of heading."""
    half = math.ceil(reach[0] / layer.cell_m)
    return SearchWindow(pose, half, half, math.ceil(reach[1] / step_rad), step_rad)


def search_bounded(
    xy_base: Floats, layer: LikelihoodLayer, window: SearchWindow, least_score: float = -math.inf
) -> SearchResult:
    """The result of search_exhaustive with fewer evaluations; xy_base: (N, 2) m, base frame.

    Score -inf and the centre where nothing reaches least_score.
    """
    first_row, last_row, first_column, last_column = cell_bounds(xy_base, window, layer.cell_m)
    level_count = min((2 * window.half_x).bit_length() + 1, MAX_LEVELS)  # a top block covers the window
    shape = (level_count, last_row - first_row + 1, last_column - first_column + 1)
    pyramid = build_pyramid(layer, first_row, first_column, np.empty(shape, layer.cells.dtype))
    found: SearchResult = search_branch_and_bound(xy_base, pyramid, window, least_score)
    return found


class Confirmation:
    """A result far from the prediction is a hypothesis, as rooms look alike: the next one must agree."""

    def __init__(self) -> None:
        self._pose_map_odom: SE2 | None = None  # predicted odom in that of the map, by the last result

    def clear(self) -> None:
        self._pose_map_odom = None

    def confirms(self, found: SE2, predicted: SE2) -> bool:
        """Whether the previous result, propagated by the prediction, agrees; both in one frame."""
        last, self._pose_map_odom = self._pose_map_odom, found @ predicted.inverse()
        if last is None:
            return False
        away = found.between(last) @ predicted
        return math.hypot(away.x_m, away.y_m) < SAME_RESULT_M and abs(away.theta_rad) < SAME_RESULT_RAD


def search_around(
    xy_base: Floats, pose: SE2, reach: tuple[float, float], layer: LikelihoodLayer, step_rad: float = STEP_RAD
) -> SE2 | None:
    """The pose of the window at which the points have the highest likelihood.

    xy_base   (N, 2) m, base frame; N > 0
    pose      centre of the window, in the frame of the map
    reach     (m, rad) half the width of the window
    step_rad  between two headings
    None where the map is empty within reach.
    Source: Hess et al. 2016, Real-Time Loop Closure in 2D LIDAR SLAM, section V.
    """
    window = window_around(np.array(pose), reach, layer, step_rad)
    found = search_bounded(thinned(xy_base, SEARCH_BEAMS), layer, window, layer.offset)
    if not found.score > layer.offset:
        return None
    x_m, y_m, theta_rad = found.pose.tolist()
    return SE2(x_m, y_m, wrap_angle(theta_rad))


def step_of(reach: tuple[float, float]) -> float:
    """Step between headings, rad, so that a window is searched within half a second."""
    return STEP_RAD if reach[1] <= WIDE_RAD else WIDE_STEP_RAD


def reach_of(prior: tuple[float, float]) -> tuple[float, float]:
    """Half the search window of a prediction, m and rad: three sigmas, within MIN_WINDOW and MAX_WINDOW."""
    reach_m, reach_rad = (
        min(max(3.0 * sigma, least), most)
        for sigma, least, most in zip(prior, MIN_WINDOW, MAX_WINDOW, strict=True)
    )
    return reach_m, reach_rad
