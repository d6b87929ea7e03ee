"""Areas and lines in the plane, and the cells of a map that they take."""

from itertools import pairwise

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats

Cells = npt.NDArray[np.int64]  # (K, 2) row and column, by rising row and column

HALF_WIDTH_CELLS = 0.75  # of a line: so wide that no path between cells, diagonal ones among them, crosses it


def is_inside(xy: Floats, corners: Floats) -> npt.NDArray[np.bool_]:
    """Whether points lie within a polygon, (...,) for xy (..., 2); corners (C, 2), the last joins the first.

    What the outline encloses an even number of times is outside.
    Source: Shimrat, Algorithm 112: Position of point relative to polygon, 1962.
    """
    inside = np.zeros(xy.shape[:-1], np.bool_)
    x, y = xy[..., 0], xy[..., 1]
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        crosses = (y >= min(y0, y1)) & (y < max(y0, y1))
        inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def area_m2(corners: Floats) -> float:
    """Of a polygon (C, 2) that does not cross itself, in either direction."""
    x, y = corners.T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def cells_inside(corners: Floats, cell_m: float) -> Cells:
    """The cells whose centre lies within a polygon (C, 2), m."""
    cells = _cells_about(corners, cell_m)
    return cells[is_inside(centres_of(cells, cell_m), corners)]


def cells_along(corners: Floats, cell_m: float) -> Cells:
    """The cells of a line through some points (C, 2), m, C > 1: gap-free, one or two cells wide."""
    taken = [_along(np.stack((a, b)), cell_m) for a, b in pairwise(corners)]
    return np.unique(np.concatenate(taken), axis=0)


def _along(ends: Floats, cell_m: float) -> Cells:
    cells = _cells_about(ends, cell_m)
    span = ends[1] - ends[0]
    to_centre = centres_of(cells, cell_m) - ends[0]
    share = np.clip(to_centre @ span / max(float(span @ span), 1e-12), 0.0, 1.0)
    aside = to_centre - share[:, None] * span
    taken: Cells = cells[np.hypot(aside[:, 0], aside[:, 1]) <= HALF_WIDTH_CELLS * cell_m]
    return taken


def _cells_about(xy: Floats, cell_m: float) -> Cells:
    low = np.floor(xy.min(axis=0) / cell_m).astype(np.int64) - 1
    high = np.floor(xy.max(axis=0) / cell_m).astype(np.int64) + 1
    row, column = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
    return np.column_stack((row.ravel(), column.ravel()))


def centres_of(cells: Cells, cell_m: float) -> Floats:
    """(K, 2) x and y, m."""
    return np.asarray((cells[:, ::-1] + 0.5) * cell_m, np.float64)
