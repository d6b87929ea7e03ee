"""A map for people: cropped to what is known, with the path driven, the origin and a scale bar.

Marks have colours of a palette whose other entries are the greys themselves: a pixel's index is its grey.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from service.geometry.poses import Floats
from service.mapstore.picture import GREY_UNKNOWN, Picture, Pixels

PATH, AXIS_X, AXIS_Y, INK = 1, 2, 3, 4
PALETTE = {PATH: (31, 111, 180), AXIS_X: (200, 40, 30), AXIS_Y: (30, 140, 50), INK: (0, 0, 0)}
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


def known_part(picture: Picture, foot: int = 0, least_width: int = 0) -> Picture:
    """The part of a map that is known, with a margin around, and so many pixels below besides."""
    left, right, top, bottom = _known(picture)
    first_row, first_column = top - MARGIN, left - MARGIN
    rows, width = bottom - top + 2 * MARGIN + foot, max(right - left + 2 * MARGIN, least_width)
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

    paths   (N, 2) m in the map each, N > 0: positions of the base in the order driven. A line each
    """
    shown = known_part(picture, FOOT, MIN_WIDTH)
    cell_m = shown.cell_m

    def line(points: Floats) -> tuple[Places, Places]:
        x_m, y_m = _line(points, cell_m / 2.0).T
        row = np.floor(shown.height - (y_m - shown.y_min_m) / cell_m).astype(np.int64)
        return row, np.floor((x_m - shown.x_min_m) / cell_m).astype(np.int64)

    marks = []
    for path in paths:
        row, column = line(path)
        marks.append(_Mark(PATH, np.concatenate((row, row + 1)), np.concatenate((column, column))))
    for colour, end in ((AXIS_X, (AXIS_M, 0.0)), (AXIS_Y, (0.0, AXIS_M))):
        row, column = line(np.array([(0.0, 0.0), end]))
        marks.append(_Mark(colour, np.concatenate((row, row + 1)), np.concatenate((column, column + 1))))
    marks.append(_scale_bar(shown))

    def bands() -> Iterator[Pixels]:
        at = 0
        for band in shown.bands():
            painted = band.copy()
            for mark in marks:
                here = (mark.row >= at) & (mark.row < at + len(band))
                here &= (mark.column >= 0) & (mark.column < shown.width)
                painted[mark.row[here] - at, mark.column[here]] = mark.colour
            at += len(band)
            yield painted

    return replace(shown, bands=bands)


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


def _scale_bar(shown: Picture) -> _Mark:
    """In the lower left corner: a bar with ends, and its length above it."""
    bar_m = scale_bar_m((shown.width - 2 * MARGIN) * shown.cell_m)
    length, words = max(round(bar_m / shown.cell_m), 1), f"{bar_m:g} m"
    foot = 5 * _ZOOM + 6  # row of the bar below the top of the words
    inked = np.zeros((foot + 5, 4 + max(length + 1, 4 * _ZOOM * len(words))), np.bool_)
    inked[foot : foot + 2, : length + 1] = True
    inked[foot - 3 : foot + 5, [0, length]] = True
    for k, letter in enumerate(words):
        glyph = np.array([[bits & 4, bits & 2, bits & 1] for bits in _FONT[letter]]) > 0
        at = 4 + 4 * _ZOOM * k
        inked[: 5 * _ZOOM, at : at + 3 * _ZOOM] |= glyph.repeat(_ZOOM, axis=0).repeat(_ZOOM, axis=1)
    row, column = np.nonzero(inked)
    return _Mark(INK, shown.height - 6 - foot + row, MARGIN + column)
