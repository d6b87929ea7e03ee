"""Maps of Li et al. 2016 at true poses: their errors are not those of the matcher."""

import numpy as np

from service.kernels.surfels import TILE_CELLS
from service.mapper.filters.deskew import BeamsConfig
from service.mapper.papers.contour_lm.contour_map import ContourMap, ContourMapConfig
from simulators.world import World
from tests.papers.true_poses import true_scans
from tests.simulated import LMS100_50HZ, Drive, begun_beside, drive, phase_m

Array = np.ndarray
BEAMS = BeamsConfig(nearest_m=0.5, farthest_m=20.0)  # of the profile
Window = tuple[float, float, float, float]  # x0, x1, y0, y1, m


def at_phase(world: World, seconds: float, seed: int) -> Drive:
    """Walls lie in the cells of the map as the seed says."""
    return drive(begun_beside(world, *phase_m(seed)), LMS100_50HZ, seconds, seed)


def offset_m(what: Drive) -> Array:
    """(2,) where the map's frame begins in the frame of the world; both have the same axes here."""
    return np.array([what.world_first.x_m, what.world_first.y_m])


def learn(what: Drive, config: ContourMapConfig, every: int = 1) -> ContourMap:
    """The map of a drive at its true poses."""
    local_map = ContourMap(config)
    for points, match in true_scans(what, BEAMS, every):
        local_map.insert(points, match)
    return local_map


def read(local_map: ContourMap, xy: Array) -> Array:
    """(N, 2) likelihood, and the highest ever, of the cells of places in the frame of the first scan."""
    level = local_map.level(0)
    cells = np.floor(xy / level.cell_m).astype(int)
    values = np.zeros((len(xy), 2))
    for k, (column, row) in enumerate(cells):
        tile = (row // TILE_CELLS - level.tiles.origin[0], column // TILE_CELLS - level.tiles.origin[1])
        if not (0 <= tile[0] < level.tiles.slots.shape[0] and 0 <= tile[1] < level.tiles.slots.shape[1]):
            continue
        slot = level.tiles.slots[tile]
        if slot >= 0:
            place = (slot, row % TILE_CELLS, column % TILE_CELLS)
            values[k] = level.likelihood[place], level.highest[place]
    return values


def grid(window: tuple[float, float, float, float], cell_m: float) -> Array:
    """(N, 2) m, centres of the cells of x0, x1, y0, y1."""
    x = np.arange(window[0] + 0.5 * cell_m, window[1], cell_m)
    y = np.arange(window[2] + 0.5 * cell_m, window[3], cell_m)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
