"""A map for people: cropped to what is known, with the path driven, the origin and a scale bar.

Marks have colours of a palette whose other entries are the greys themselves: a pixel's index is its grey.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.mapstore.picture import GREY_UNKNOWN, Picture, Pixels

WAY, AXIS_X, AXIS_Y, INK = 1, 2, 3, 4
PALETTE = {WAY: (31, 111, 180), AXIS_X: (200, 40, 30), AXIS_Y: (30, 140, 50), INK: (0, 0, 0)}
MARGIN = 12  # pixels around what is known
FOOT = 24  # pixels below, for the scale bar
MIN_WIDTH = 96  # room for a bar and its words
BAR_SHARE = 0.25  # of the width: about how long the bar is
AXIS_M = 1.0  # of the origin's two arms: x red, y green

Places = npt.NDArray[np.int64]  # (N,) rows from the top, or columns

_FONT = {  # 3 x 5 pixels, rows from the top, three bits each: what scale_bar_m can need
    "0": (7, 5, 5, 5, 7),
    "1": (2, 6, 2, 2, 7),
    "2": (7, 1, 7, 4, 7),
    "5": (7, 4, 7, 1, 7),
    ".": (0, 0, 0, 0, 2),
    "m": (0, 0, 7, 7, 5),
    " ": (0, 0, 0, 0, 0),
}
_ZOOM = 2  # of a glyph's pixels


@dataclass(frozen=True, slots=True, eq=False)
class _Mark:
    """Pixels of one colour."""

    colour: int
    row: Places
    column: Places


def scale_bar_m(width_m: float, share: float = BAR_SHARE) -> float:
    """1, 2 or 5 times a power of ten, at most that share of the width; 1 cm at least."""
    most = max(width_m * share, 0.01) * (1.0 + 1e-9)
    decade = 10.0 ** math.floor(math.log10(most))
    return max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= most)


def known_part(picture: Picture, margin: int = MARGIN) -> Picture:
    """The part of a map that is known, with so many pixels around."""
    left, right, top, bottom = _known(picture)
    first_row, first_column = top - margin, left - margin
    rows, width = bottom - top + 2 * margin, right - left + 2 * margin
    return Picture(
        width,
        rows,
        picture.cell_m,
        picture.x_min_m + first_column * picture.cell_m,
        picture.y_min_m + (picture.height - first_row - rows) * picture.cell_m,
        lambda: _cut(picture, first_row, rows, first_column, width),
    )


def annotated(picture: Picture, paths: Sequence[Floats] = ()) -> Picture:
    """The part of a map that is known, with marks; to be written with PALETTE.

    ways    (N, 2) m in the map each, N > 0: where the base was, in the order driven. A line each
    """
    left, right, top, bottom = _known(picture)
    width = max(right - left + 2 * MARGIN, MIN_WIDTH)
    first_row, rows = top - MARGIN, bottom - top + 2 * MARGIN + FOOT
    first_column = left - MARGIN
    cell_m = picture.cell_m
    x_min_m = picture.x_min_m + first_column * cell_m
    y_min_m = picture.y_min_m + (picture.height - first_row - rows) * cell_m

    def pixels_of(x_m: npt.NDArray[np.float64], y_m: npt.NDArray[np.float64]) -> tuple[Places, Places]:
        row = np.floor(rows - (y_m - y_min_m) / cell_m).astype(np.int64)
        return row, np.floor((x_m - x_min_m) / cell_m).astype(np.int64)

    marks = []
    for path in paths:
        row, column = pixels_of(*_line(path, cell_m / 2.0).T)
        marks.append(_Mark(WAY, np.concatenate((row, row + 1)), np.concatenate((column, column))))
    for colour, end in ((AXIS_X, (AXIS_M, 0.0)), (AXIS_Y, (0.0, AXIS_M))):
        row, column = pixels_of(*_line(np.array([(0.0, 0.0), end]), cell_m / 2.0).T)
        marks.append(_Mark(colour, np.concatenate((row, row + 1)), np.concatenate((column, column + 1))))
    marks += _scale_bar(rows, width, cell_m)

    def bands() -> Iterator[Pixels]:
        at = 0
        for band in _cut(picture, first_row, rows, first_column, width):
            painted = band.copy()
            for mark in marks:
                here = (mark.row >= at) & (mark.row < at + len(band))
                here &= (mark.column >= 0) & (mark.column < width)
                painted[mark.row[here] - at, mark.column[here]] = mark.colour
            at += len(band)
            yield painted

    return Picture(width, rows, cell_m, x_min_m, y_min_m, bands)


def _known(picture: Picture) -> tuple[int, int, int, int]:
    """left, right, top, bottom of what is not unknown, right and bottom excluded; of all where nothing is."""
    columns = np.zeros(picture.width, dtype=bool)
    rows = []
    for band in picture.bands():
        known = band != GREY_UNKNOWN
        columns |= known.any(axis=0)
        rows.append(known.any(axis=1))
    column, row = np.flatnonzero(columns), np.flatnonzero(np.concatenate(rows))
    if not len(column):
        return 0, picture.width, 0, picture.height
    return int(column[0]), int(column[-1]) + 1, int(row[0]), int(row[-1]) + 1


def _cut(picture: Picture, first_row: int, rows: int, first_column: int, width: int) -> Iterator[Pixels]:
    """Some rows and columns of a picture, in bands; what lies outside of it is unknown."""
    last_row = first_row + rows
    if first_row < 0:
        yield np.full((-first_row, width), GREY_UNKNOWN, dtype=np.uint8)
    at = 0
    for band in picture.bands():
        low, high = max(first_row - at, 0), min(last_row - at, len(band))
        at += len(band)
        if low >= high:
            continue
        cut = np.full((high - low, width), GREY_UNKNOWN, dtype=np.uint8)
        inside = band[low:high, max(first_column, 0) : first_column + width]
        begin = max(-first_column, 0)
        cut[:, begin : begin + inside.shape[1]] = inside
        yield cut
    if last_row > picture.height:
        yield np.full((last_row - picture.height, width), GREY_UNKNOWN, dtype=np.uint8)


def _line(points: npt.NDArray[np.float64], step_m: float) -> npt.NDArray[np.float64]:
    """(M, 2) points along a polyline, at most step_m apart."""
    length_m = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
    path_length_m = np.concatenate(([0.0], np.cumsum(length_m)))
    at = np.linspace(0.0, path_length_m[-1], max(math.ceil(path_length_m[-1] / step_m), 1) + 1)
    return np.column_stack([np.interp(at, path_length_m, points[:, k]) for k in (0, 1)])


def _scale_bar(rows: int, width: int, cell_m: float) -> list[_Mark]:
    """In the lower left corner: a bar with ends, and its length above it."""
    bar_m = scale_bar_m((width - 2 * MARGIN) * cell_m)
    length, foot = max(round(bar_m / cell_m), 1), rows - 6
    along = np.arange(length + 1)
    row = [np.full(2 * len(along), foot)]
    row[0][len(along) :] += 1
    column = [np.tile(MARGIN + along, 2)]
    for end in (MARGIN, MARGIN + length):
        row.append(np.arange(foot - 3, foot + 5))
        column.append(np.full(8, end))
    words = f"{bar_m:g} m"
    for k, letter in enumerate(words):
        for j, bits in enumerate(_FONT[letter]):
            for i in range(3):
                if bits & (4 >> i):
                    at_row = foot - 6 - (5 - j) * _ZOOM
                    at_column = MARGIN + 4 + (k * 4 + i) * _ZOOM
                    square = np.arange(_ZOOM)
                    row.append(np.repeat(at_row + square, _ZOOM))
                    column.append(np.tile(at_column + square, _ZOOM))
    return [_Mark(INK, np.concatenate(row), np.concatenate(column))]
