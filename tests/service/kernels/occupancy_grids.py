import numpy as np

from service.kernels.occupancy import GRID_TILE_CELLS, OccupancyGrid
from service.kernels.tiles import NO_TILE, TileIndex


def empty_tiles() -> TileIndex:
    """Room for 16 tiles, two to each side of the origin."""
    return TileIndex(
        np.full((4, 4), NO_TILE, np.int32),
        np.array([-2, -2], np.int64),
        np.empty(16, np.int32),
        np.zeros(2, np.int64),
    )


def empty_occupancy(cell_m: float) -> OccupancyGrid:
    shape = (16, GRID_TILE_CELLS, GRID_TILE_CELLS)
    return OccupancyGrid(
        empty_tiles(), np.zeros(shape, np.int8), np.zeros(shape, np.uint16), np.zeros(16, np.uint8), cell_m
    )
