import math

import numpy as np
import pytest

from service.kernels.cell_moments import (
    HALVES,
    MIN_POINTS,
    MOMENT_TILE_CELLS,
    MOMENTS,
    RESTART_POINTS,
    WEIGHT,
    MomentGrid,
    add_to_moments,
    direct_by_moments,
)
from service.kernels.normals import ROUGH_WEIGHT
from service.kernels.tiles import NO_TILE, TileIndex

SIGMA_M = 0.012
SENSOR = np.zeros(2)
FACE_X_M = 6.04  # of a wall across the beams, from y = 1.00 to 1.25: the far side of a sunk door


def empty_moments(tiles_each_way: int = 8, used_slots: int = 0) -> MomentGrid:
    """used_slots were handed back, dirt in them."""
    width = 2 * tiles_each_way
    capacity = width * width + used_slots
    index = TileIndex(
        np.full((width, width), NO_TILE, np.int32),
        np.array([-tiles_each_way, -tiles_each_way], np.int64),
        np.arange(capacity, dtype=np.int32),
        np.array([used_slots, used_slots], np.int64),
    )
    moments = np.zeros((capacity, MOMENT_TILE_CELLS, MOMENT_TILE_CELLS, HALVES, MOMENTS), np.float32)
    moments[:used_slots] = 9.0
    return MomentGrid(index, moments, 0.1)


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


FACE = np.array([[FACE_X_M, 1.0], [FACE_X_M, 1.25]])


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


def test_two_beams_a_key_frame_add_up_to_a_wall() -> None:
    noise, grid = np.random.default_rng(1), empty_moments()
    middle = np.array([[FACE_X_M, 1.12]])
    assert directed(grid, middle, 0)[0, 2] == ROUGH_WEIGHT
    for _ in range(30):
        add(grid, seen(noise, FACE), 0)
    nx, ny, weight = directed(grid, middle, 0)[0]
    assert math.hypot(nx, ny) == pytest.approx(1.0)
    assert abs(math.atan2(ny, -nx)) < 0.1  # towards the sensor
    cosine = -np.dot((nx, ny), middle[0] / np.hypot(*middle[0]))
    assert weight == pytest.approx(1.0 / (cosine**2 + (1.0 - cosine**2) / 5.0))


def test_few_points_have_no_direction() -> None:
    noise, grid = np.random.default_rng(2), empty_moments()
    xy = np.vstack([seen(noise, FACE) for _ in range(int(MIN_POINTS) // 2)])[:-1]
    add(grid, xy, 0)
    assert np.all(directed(grid, xy, 0)[:, 2] == ROUGH_WEIGHT)


def test_halves_have_nothing_in_common() -> None:
    noise, grid = np.random.default_rng(3), empty_moments()
    for _ in range(30):
        add(grid, seen(noise, FACE), 1)
    middle = np.array([[FACE_X_M, 1.12]])
    assert directed(grid, middle, 0)[0, 2] == ROUGH_WEIGHT
    assert directed(grid, middle, 1)[0, 2] >= 1.0


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


def test_what_has_no_plane_stays_rough() -> None:
    noise, grid = np.random.default_rng(4), empty_moments()
    for _ in range(60):
        add(grid, np.array([6.0, 1.1]) + 0.15 * noise.uniform(-1.0, 1.0, (3, 2)), 0)
    points = np.array([6.0, 1.1]) + 0.1 * noise.uniform(-1.0, 1.0, (50, 2))
    assert np.mean(directed(grid, points, 0)[:, 2] != ROUGH_WEIGHT) < 0.1


def test_a_point_behind_the_corner_belongs_to_no_plane_and_is_not_taken_in() -> None:
    noise, grid = np.random.default_rng(5), empty_moments()
    for _ in range(30):
        add(grid, seen(noise, FACE), 0)
    behind = np.array([[FACE_X_M + 0.05, 1.05]])
    assert directed(grid, behind, 0)[0, 2] == ROUGH_WEIGHT  # in a match it counts as little as before
    assert directed(grid, behind, 0, 0.0)[0, 2] == 0.0
    before = grid.moments[..., WEIGHT].sum()
    add(grid, behind, 0)
    assert grid.moments[..., WEIGHT].sum() == before


def test_a_cell_that_is_no_plane_begins_again_and_finds_it() -> None:
    """Points behind a corner came first: the cell would never be a plane with them in it."""
    noise, grid = np.random.default_rng(6), empty_moments()
    corner = np.array([[FACE_X_M, 1.2], [FACE_X_M, 1.3]])
    add(grid, np.array([[FACE_X_M + d, 1.25] for d in (0.05, 0.04, 0.05, 0.05, 0.04, 0.05)]), 0)
    for _ in range(60):
        add(grid, seen(noise, corner), 0)
    nx, ny, weight = directed(grid, np.array([[FACE_X_M, 1.24]]), 0)[0]
    assert weight >= 1.0
    assert abs(math.atan2(ny, -nx)) < 0.25
    moments = grid.moments[..., 0, :]
    assert moments[..., WEIGHT].max() * SIGMA_M**2 >= RESTART_POINTS


def test_the_noisier_laser_counts_less() -> None:
    """A face at 6.04 m by one laser, and 3 cm behind by another, four times as noisy."""
    noise, grid = np.random.default_rng(7), empty_moments()
    for _ in range(5):
        add_to_moments(xy := seen(noise, FACE), SENSOR, SIGMA_M, rough(xy), rough(xy), np.zeros(3), grid, 0)
        behind = seen(noise, FACE + np.array([0.03, 0.0]), sigma_m=4.0 * SIGMA_M)
        add_to_moments(behind, SENSOR, 4.0 * SIGMA_M, rough(behind), rough(behind), np.zeros(3), grid, 0)
    cells = grid.moments[..., 0, :].reshape(-1, MOMENTS)
    weights = cells[:, WEIGHT] * SIGMA_M**2
    assert weights.sum() == pytest.approx(10.0 + 10.0 / 16.0, rel=1e-5)


def test_a_tile_that_was_used_before_is_cleared() -> None:
    noise, grid = np.random.default_rng(8), empty_moments(used_slots=3)
    xy = seen(noise, FACE)
    add(grid, xy, 0)
    taken = grid.tiles.slots[grid.tiles.slots != NO_TILE]
    assert grid.moments[taken, :, :, 0, WEIGHT].sum() == pytest.approx(2.0 / SIGMA_M**2, rel=1e-5)
    assert np.all(grid.moments[taken, :, :, 1] == 0.0)


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
