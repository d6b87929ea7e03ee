"""Grids for the tests of kernels that read or fill them."""

import numpy as np

from service.kernels.surfels import COLUMNS, TILE_CELLS, SurfelGrid
from service.kernels.tiles import NO_TILE, TileIndex


def empty_grid(cell_m: float = 0.1, tiles_each_way: int = 4, used_slots: int = 0) -> SurfelGrid:
    """Room for tiles_each_way tiles on each side of the origin; used_slots were handed back, dirt in them."""
    width = 2 * tiles_each_way
    capacity = width * width + used_slots
    index = TileIndex(
        np.full((width, width), NO_TILE, np.int32),
        np.array([-tiles_each_way, -tiles_each_way], np.int64),
        np.arange(capacity, dtype=np.int32)[::-1].copy(),
        np.array([0, used_slots], np.int64),
    )
    index.free[:used_slots] = np.arange(used_slots)
    index.counts[0] = used_slots
    grid = SurfelGrid(
        index,
        np.zeros((capacity, TILE_CELLS, TILE_CELLS, 2, COLUMNS), np.float32),
        np.zeros((capacity, TILE_CELLS, TILE_CELLS), np.float32),
        cell_m,
    )
    grid.surfels[:used_slots] = 9.0
    grid.field[:used_slots] = 9.0
    return grid
