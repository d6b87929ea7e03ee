"""Where a scan lies on a sub-map when the prediction was far off: a whole window, by branch and bound."""

import math

import numpy as np
import numpy.typing as npt

from service.kernels.likelihood_search import LikelihoodLayer, SearchWindow
from service.kernels.surfels import SurfelGrid
from service.mapper.matchers.window_search import search_bounded

Floats = npt.NDArray[np.float64]

BEAMS = 150  # about so many are asked
STEP_RAD = 0.02  # a cell of 10 cm at 5 m


def search_around(
    xy_base: Floats, pose: Floats, reach_m: float, reach_rad: float, grid: SurfelGrid
) -> Floats | None:
    """The pose of the window at which the points lie best on the likelihood field of a sub-map.

    xy_base               (N, 2) m, base frame; N > 0
    pose                  (3,) middle of the window, in the frame of the grid
    reach_m, reach_rad    half the width of the window
    None where nothing of the field lies within reach.
    Source: Hess et al. 2016, Real-Time Loop Closure in 2D LIDAR SLAM, section V.
    """
    thin = np.ascontiguousarray(xy_base[:: max(1, len(xy_base) // BEAMS)])
    half = math.ceil(reach_m / grid.cell_m)
    window = SearchWindow(pose, half, half, math.ceil(reach_rad / STEP_RAD), STEP_RAD)
    layer = LikelihoodLayer(grid.tiles, grid.field, 0.0, 0.0, 1.0, grid.cell_m)
    found = search_bounded(thin, np.ones(len(thin), np.float32), layer, window, 0.0)
    return found.pose if found.score > 0.0 else None
