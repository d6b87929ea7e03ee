"""Branch and bound over the part of a likelihood map that a window reaches."""

import numpy as np
import numpy.typing as npt

from service.kernels.branch_and_bound import build_pyramid, search_branch_and_bound
from service.kernels.likelihood_search import LikelihoodLayer, SearchResult, SearchWindow, cells_asked

MOST_LEVELS = 4  # of the pyramid: blocks of at most 8 x 8 candidates


def search_bounded(
    xy_base: npt.NDArray[np.float64],
    weights: npt.NDArray[np.float32],
    layer: LikelihoodLayer,
    window: SearchWindow,
    least_score: float,
) -> SearchResult:
    """What search_exhaustive finds, asking fewer; (N, 2) m in the base frame, (N,) none below 0.

    Score -inf and the centre where nothing reaches least_score.
    """
    first_row, last_row, first_column, last_column = cells_asked(xy_base, window, layer.cell_m)
    level_count = min((2 * window.half_x).bit_length() + 1, MOST_LEVELS)  # a block is the whole window
    shape = (level_count, last_row - first_row + 1, last_column - first_column + 1)
    pyramid = build_pyramid(layer, first_row, first_column, np.empty(shape, layer.cells.dtype))
    found: SearchResult = search_branch_and_bound(xy_base, weights, pyramid, window, least_score)
    return found
