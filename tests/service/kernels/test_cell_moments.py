import math

import numpy as np

from service.kernels.cell_moments import (
    HALVES,
    MOMENTS,
    MomentGrid,
    add_to_moments,
    direct_by_moments,
)
from service.kernels.normals import ROUGH_WEIGHT
from service.kernels.surfels import TILE_CELLS
from tests.service.kernels.grids import empty_tiles

SIGMA_M = 0.012
SENSOR = np.zeros(2)
FACE_X_M = 6.04  # of a wall across the beams, from y = 1.00 to 1.25: the far side of a sunk door


def empty_moments(half_tiles: int = 8) -> MomentGrid:
    tiles = empty_tiles(half_tiles)
    shape = (len(tiles.free), TILE_CELLS, TILE_CELLS, HALVES, MOMENTS)
    return MomentGrid(tiles, np.zeros(shape, np.float32), 0.1)


def rough(xy: np.ndarray) -> np.ndarray:
    """Normals of points that one scan gives no direction: towards the sensor."""
    return np.column_stack((-xy / np.hypot(*xy.T)[:, None], np.full(len(xy), ROUGH_WEIGHT)))


def seen(
    noise: np.random.Generator, corners: np.ndarray, beams: int = 2, sigma_m: float = SIGMA_M
) -> np.ndarray:
    """Points of beams that hit a wall between two corners somewhere, with the noise of a range."""
    along = noise.uniform(0.0, 1.0, (beams, 1))
    xy = corners[0] + along * (corners[1] - corners[0])
    return xy + sigma_m * noise.standard_normal((beams, 1)) * xy / np.hypot(*xy.T)[:, None]


def directed(
    grid: MomentGrid, xy: np.ndarray, half: int, off_weight: float = ROUGH_WEIGHT, sigma_m: float = SIGMA_M
) -> np.ndarray:
    normals = rough(xy)
    direct_by_moments(xy, SENSOR, sigma_m, np.zeros(3), grid, half, 5.0, off_weight, normals)
    return normals


def add(grid: MomentGrid, xy: np.ndarray, half: int, sigma_m: float = SIGMA_M) -> None:
    """As a key frame does: points that lie beside a plane that is known are left out."""
    add_to_moments(
        xy, SENSOR, sigma_m, rough(xy), directed(grid, xy, half, 0.0, sigma_m), np.zeros(3), grid, half
    )


def test_noise_along_the_beams_tilts_no_narrow_wall_that_is_seen_aslant() -> None:
    """10 cm, 60 degrees from head-on: what noise adds along the wall is as much as the wall is long."""
    middle = np.array([4.05, -1.05])
    bearing = math.atan2(middle[1], middle[0]) + math.radians(60.0)
    along = np.array([-math.sin(bearing), math.cos(bearing)])
    true = -np.array([math.cos(bearing), math.sin(bearing)])
    tilts = []
    for seed in range(100):
        noise, grid = np.random.default_rng(seed), empty_moments()
        for _ in range(40):
            add(grid, seen(noise, np.array([middle - 0.05 * along, middle + 0.05 * along])), 0)
        nx, ny, weight = directed(grid, middle[None, :], 0)[0]
        assert weight >= 1.0
        tilts.append(math.asin(nx * true[1] - ny * true[0]))
    assert abs(np.mean(tilts)) < 0.02  # 0.065 with the noise left in the squares


def test_the_side_of_a_door_no_deeper_than_a_cell_has_a_direction_between_its_walls() -> None:
    """10 cm deep: points of the walls before and behind it, by turns, lie in its cells, too."""
    before = np.array([[FACE_X_M - 0.15, 1.1], [FACE_X_M, 1.1]])
    side = np.array([[FACE_X_M, 1.0], [FACE_X_M, 1.1]])
    behind = np.array([[FACE_X_M, 1.0], [FACE_X_M + 0.15, 1.0]])
    middle = np.array([[FACE_X_M, 1.05]])
    beyond = np.array([[FACE_X_M - 0.01, 1.11], [FACE_X_M + 0.01, 0.99]])  # of those walls
    tilts, taken = [], 0
    for seed in range(20):
        noise, grid = np.random.default_rng(seed), empty_moments()
        for k in range(60):
            add(grid, np.vstack((seen(noise, side), seen(noise, (before, behind)[k % 2], 1))), 0)
        nx, ny, weight = directed(grid, middle, 0)[0]
        if weight >= 1.0:
            tilts.append(abs(math.atan2(ny, -nx)))
        taken += np.count_nonzero(directed(grid, beyond, 0)[:, 2] != ROUGH_WEIGHT)
    assert len(tilts) >= 15
    assert np.median(tilts) < 0.2
    assert taken <= 4  # of 40; 17 if the ends of the side did not count
