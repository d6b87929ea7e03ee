"""Kernels of the shown map that no short drive calls, once, so that no scan waits for a compiler."""

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan
from service.geometry.se2 import SE2
from service.kernels.occupancy import TILE_CELLS
from service.mapper.components import Points, RenderedMap
from service.mapper.map_changes import ChangeWatch
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles

CELL_M = 0.05


def warm_up_replacing() -> None:
    """A map rendered anew replaces the shown one, with a person's wall in a tile of its own."""
    wall = np.full((1, 2), TILE_CELLS, np.int64)
    shown = OccupancyTiles(OccupancyConfig(), CELL_M)
    shown.replace_by(_one_tile(wall), ())
    shown.changed_tiles()


def warm_up_changes() -> None:
    """A scan is compared with a stored map."""
    range_m = np.ones(2, np.float32)
    scan = LaserScan("laser", 0, 0, 0, 0, 0.0, 0.1, 0.0, 10.0, range_m, NO_INTENSITY)
    xy = np.ones((2, 2))
    points = Points(xy, xy, np.zeros(2), np.arange(2, dtype=np.int32), SE2(), scan)
    ChangeWatch(_one_tile(np.zeros((0, 2), np.int64)), CELL_M).add(points, SE2(), 0)


def _one_tile(wall_cells: np.ndarray[tuple[int, int], np.dtype[np.int64]]) -> RenderedMap:
    at = np.zeros(1, np.int64)
    return RenderedMap(at, at.copy(), np.zeros((1, TILE_CELLS, TILE_CELLS), np.int8), wall_cells)
