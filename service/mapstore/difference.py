"""What differs between the tiles of two maps in one frame: counted, and as a picture."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view

from service.errors import InputError
from service.mapstore.picture import (
    BLACK_OCCUPIED,
    FREE_THRESH,
    GREY_UNKNOWN,
    OCCUPIED_THRESH,
    WHITE_FREE,
    Picture,
    Pixels,
    picture_of_squares,
)
from service.outputs import UNKNOWN, TileUpdate

WALL_NEW, WALL_GONE, AREA_NEW, AREA_GONE = 20, 21, 22, 23
COLOURS = {  # a wall stands over its area
    AREA_NEW: (200, 240, 205),
    AREA_GONE: (250, 210, 205),
    WALL_NEW: (0, 140, 40),
    WALL_GONE: (210, 30, 30),
}
_UNKNOWN, _FREE, _OCCUPIED, _UNSURE = range(4)
_KIND = np.full(256, _UNKNOWN, np.uint8)  # by occupancy in per cent, as a byte
_KIND[:101] = _UNSURE
_KIND[: int(FREE_THRESH * 100) + 1] = _FREE
_KIND[int(OCCUPIED_THRESH * 100) : 101] = _OCCUPIED
_GREY = np.array([GREY_UNKNOWN, WHITE_FREE, BLACK_OCCUPIED, GREY_UNKNOWN], np.uint8)


@dataclass(frozen=True, slots=True)
class CellCounts:
    """Cells of the finest level that are not in both maps what they are in one."""

    area_new: int  # unknown before, known now
    area_gone: int
    walls_new: int  # occupied now, and not before
    walls_gone: int
    changed: int  # free, occupied, unsure or unknown in one and something else in the other


@dataclass(frozen=True, slots=True)
class CommonCells:
    """Cells of the finest level that both maps know, walls of the second among them, and those of these that
    are within a cell of a wall of the first.
    """

    area: int
    walls: int
    walls_near: int


class Difference:
    """Of the finest tiles of two maps, the second as changed against the first.

    Raises InputError where their tiles or cells are of different size.
    """

    def __init__(self, before: Sequence[TileUpdate], after: Sequence[TileUpdate]) -> None:
        self._before, self._after = (
            {(tile.ix, tile.iy): tile.cells for tile in tiles if tile.level == 0} for tiles in (before, after)
        )
        sizes = {(len(tile.cells), tile.cell_m) for tile in (*before, *after) if tile.level == 0}
        if len(sizes) > 1:
            facts = " and ".join(f"{edge} x {edge} cells of {cell_m:g} m" for edge, cell_m in sorted(sizes))
            raise InputError(f"the maps have tiles of {facts}; they cannot be compared cell by cell")
        ((self._edge, self.cell_m),) = sizes

    def counts(self) -> CellCounts:
        total = np.zeros(5, np.int64)
        for key in self._before.keys() | self._after.keys():
            old, new = self._kinds(key)
            total += [np.count_nonzero(which) for which in (*_differing(old, new), old != new)]
        return CellCounts(*total.tolist())

    def common(self) -> CommonCells:
        total = np.zeros(3, np.int64)
        for key in self._before.keys() & self._after.keys():
            old, new = self._kinds(key)
            is_common = (old != _UNKNOWN) & (new != _UNKNOWN)
            walls = is_common & (new == _OCCUPIED)
            near = sliding_window_view(np.pad(old == _OCCUPIED, 1), (3, 3)).any(axis=(2, 3))
            total += [np.count_nonzero(which) for which in (is_common, walls, walls & near)]
        return CommonCells(*total.tolist())

    def picture(self) -> Picture:
        """The second map in grey, and what differs in COLOURS. Raises StorageError beyond MAX_PIXELS."""
        return picture_of_squares(
            self._before.keys() | self._after.keys(), self._edge, self.cell_m, self._pixels
        )

    def _pixels(self, key: tuple[int, int]) -> Pixels:
        old, new = self._kinds(key)
        pixels: Pixels = _GREY[new]
        for colour, which in zip(COLOURS, _differing(old, new), strict=True):
            pixels[which] = colour
        return pixels[::-1]

    def _kinds(self, key: tuple[int, int]) -> tuple[Pixels, Pixels]:
        nothing = np.full((self._edge, self._edge), UNKNOWN, np.int8)
        return tuple(_KIND[side.get(key, nothing).view(np.uint8)] for side in (self._before, self._after))  # type: ignore[return-value]


def _differing(old: Pixels, new: Pixels) -> tuple[npt.NDArray[np.bool_], ...]:
    """Where an area is new, where one is gone, and the same of walls; the order of COLOURS."""
    return (
        (old == _UNKNOWN) & (new != _UNKNOWN),
        (old != _UNKNOWN) & (new == _UNKNOWN),
        (old != _OCCUPIED) & (new == _OCCUPIED),
        (old == _OCCUPIED) & (new != _OCCUPIED),
    )
