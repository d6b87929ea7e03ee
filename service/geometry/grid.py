"""Metres <-> cells <-> tiles.

Cell (row, column) covers [column, column + 1) x [row, row + 1) times the edge of a cell, in the frame of the
map; so rows run along y, columns along x, and both may be negative.
"""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TileRange:
    """A rectangle of tiles, last ones included."""

    first_row: int
    first_column: int
    last_row: int
    last_column: int

    @property
    def tile_count(self) -> int:
        return (self.last_row - self.first_row + 1) * (self.last_column - self.first_column + 1)


def cell_of(coordinate_m: float, cell_m: float) -> int:
    """Row or column of the cell that holds a coordinate."""
    return math.floor(coordinate_m / cell_m)


def tiles_of(
    low_xy_m: tuple[float, float],
    high_xy_m: tuple[float, float],
    cell_m: float,
    tile_bits: int,
    margin_cells: int = 0,
) -> TileRange:
    """Tiles of 2**tile_bits cells a side that cover a box and margin_cells around it."""
    return TileRange(
        first_row=(cell_of(low_xy_m[1], cell_m) - margin_cells) >> tile_bits,
        first_column=(cell_of(low_xy_m[0], cell_m) - margin_cells) >> tile_bits,
        last_row=(cell_of(high_xy_m[1], cell_m) + margin_cells) >> tile_bits,
        last_column=(cell_of(high_xy_m[0], cell_m) + margin_cells) >> tile_bits,
    )
