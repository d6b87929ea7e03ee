"""Grids without content for the tests of kernels that read or fill them."""

import numpy as np

from service.kernels.occupancy import GRID_TILE_CELLS, OccupancyGrid
from service.kernels.surfels import COLUMNS, TILE_CELLS, SurfelGrid
from service.kernels.tiles import NO_TILE, TileIndex

DIRT = 9.0  # in slots that were used before


def empty_tiles(half_tiles: int = 2, used_slots: int = 0) -> TileIndex:
    """Room for half_tiles tiles on each side of the origin; used_slots are free again."""
    width = 2 * half_tiles
    free = np.arange(width * width + used_slots, dtype=np.int32)
    origin, counts = np.full(2, -half_tiles, np.int64), np.full(2, used_slots, np.int64)
    return TileIndex(np.full((width, width), NO_TILE, np.int32), origin, free, counts)


def empty_grid(cell_m: float = 0.1, half_tiles: int = 4, used_slots: int = 0) -> SurfelGrid:
    tiles = empty_tiles(half_tiles, used_slots)
    shape = (len(tiles.free), TILE_CELLS, TILE_CELLS)
    grid = SurfelGrid(tiles, np.zeros((*shape, 2, COLUMNS), np.float32), np.zeros(shape, np.float32), cell_m)
    grid.surfels[:used_slots] = grid.field[:used_slots] = DIRT
    return grid


def empty_occupancy(cell_m: float) -> OccupancyGrid:
    tiles = empty_tiles()
    shape = (len(tiles.free), GRID_TILE_CELLS, GRID_TILE_CELLS)
    marks = np.zeros(shape, np.uint16), np.zeros(len(tiles.free), np.uint8)
    return OccupancyGrid(tiles, np.zeros(shape, np.int8), *marks, cell_m)
