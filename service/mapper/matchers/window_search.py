"""Windows of candidate poses on a likelihood map, searched by branch and bound."""

import math

import numpy as np

from service.geometry.poses import Floats
from service.kernels.branch_and_bound import MaxPyramid, build_pyramid, search_branch_and_bound
from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_search import LikelihoodLayer, SearchResult, SearchWindow, cell_bounds

MAX_LEVELS = 4  # of the pyramid: blocks of at most 8 x 8 candidates


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
