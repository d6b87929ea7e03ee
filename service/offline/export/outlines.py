"""Occupied cells of a map as outlines: closed polygons that drawings can show."""

import numpy as np
import numpy.typing as npt

from service.mapstore.picture import BLACK_OCCUPIED, Picture

Points = npt.NDArray[np.float64]  # (N, 2) x, y; m, map frame
TOLERANCE_CELLS = 1.0  # a slanting wall is a staircase of cells, whose corners lie less than one off its line
MIN_AREA = 0.5  # of a loop, that thinning has to leave: a wall of one cell would collapse


def occupied_cells(picture: Picture) -> npt.NDArray[np.bool_]:
    """(H, W), row 0 lowest."""
    return np.vstack([band == BLACK_OCCUPIED for band in picture.bands()])[::-1]


def occupied_points(picture: Picture) -> Points:
    """Middles of occupied cells, row by row from below."""
    rows, columns = np.nonzero(occupied_cells(picture))
    low = np.array([picture.x_min_m, picture.y_min_m])
    points: Points = low + (np.column_stack((columns, rows)) + 0.5) * picture.cell_m
    return points


def outlines(picture: Picture) -> list[Points]:
    """Closed polygons around occupied cells, counter-clockwise, holes clockwise; the first point stands once.

    They stay within TOLERANCE_CELLS of the edges of the cells. Source of the thinning: Douglas, Peucker,
    Algorithms for the reduction of the number of points ..., Cartographica 10 (1973).
    """
    low = np.array([picture.x_min_m, picture.y_min_m])
    loops = _loops(occupied_cells(picture))
    return [low + _simplified(loop) * picture.cell_m for loop in loops]


def _loops(occupied: npt.NDArray[np.bool_]) -> list[Points]:
    """Corners of cells, in cells from the lower left. Each step is an edge, the occupied cell to its left."""
    padded = np.pad(occupied, 1)
    inside = padded[1:-1, 1:-1]
    sides = (  # beside which the edge lies, its first and its second corner against the cell's lower left one
        (padded[:-2, 1:-1], (0, 0), (1, 0)),
        (padded[1:-1, 2:], (1, 0), (1, 1)),
        (padded[2:, 1:-1], (1, 1), (0, 1)),
        (padded[1:-1, :-2], (0, 1), (0, 0)),
    )
    follows: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for beside, (x1, y1), (x2, y2) in sides:
        rows, columns = np.nonzero(inside & ~beside)
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            follows.setdefault((column + x1, row + y1), []).append((column + x2, row + y2))
    loops = []
    for start in sorted(follows):
        while follows[start]:
            loops.append(np.array(_walk(follows, start), dtype=np.float64))
    return loops


def _walk(
    follows: dict[tuple[int, int], list[tuple[int, int]]], start: tuple[int, int]
) -> list[tuple[int, int]]:
    """Take one loop out of the edges. Where two cells touch by a corner it turns left, to its own cell."""
    loop, here, direction = [], start, (0, 0)
    while True:
        loop.append(here)
        nexts = follows[here]
        left = (here[0] - direction[1], here[1] + direction[0])
        next_ = nexts.pop(nexts.index(left) if left in nexts else 0)
        direction = (next_[0] - here[0], next_[1] - here[1])
        here = next_
        if here == start:
            return loop


def _simplified(loop: Points) -> Points:
    corners = _thinned(loop, 1e-9)
    simple = _thinned(corners, TOLERANCE_CELLS)
    return simple if abs(_area(simple)) >= MIN_AREA * abs(_area(corners)) else corners


def _area(loop: Points) -> float:
    """Area by the shoelace formula."""
    x, y = loop.T
    return 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def _thinned(loop: Points, tolerance: float) -> Points:
    """The loop with only the points that it needs: it is cut at the two that lie farthest apart."""
    far = int(np.argmax(((loop - loop[0]) ** 2).sum(axis=1)))
    closed = np.vstack((loop, loop[:1]))
    kept = np.zeros(len(closed), dtype=bool)
    kept[[0, far]] = True
    spans = [(0, far), (far, len(loop))]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        between = closed[first + 1 : last] - closed[first]
        chord = closed[last] - closed[first]
        length = float(np.hypot(*chord))
        away = np.abs(between @ np.array([-chord[1], chord[0]])) / length if length else np.hypot(*between.T)
        k = int(np.argmax(away))
        if away[k] > tolerance:
            middle = first + 1 + k
            kept[middle] = True
            spans += [(first, middle), (middle, last)]
    return closed[:-1][kept[:-1]]
