import math

import numpy as np
import pytest

from service.kernels import surfels, tiles
from service.kernels.surfels import (
    COSINES,
    REACH_CELLS,
    ROUND_SHARE,
    SURFELS_AROUND,
    TILE_BITS,
    TILE_MASK,
    SurfelGrid,
    insert_surfels,
)
from tests.service.kernels.grids import empty_grid
from tests.service.kernels.inner import from_python

find_surfels = from_python(surfels.find_surfels)
find_tile = from_python(tiles.find_tile)

find_surfels_cached = from_python(surfels.find_surfels_cached)
empty_cache = from_python(surfels.empty_cache)
POSE = np.array([0.3, -0.4, 0.7])


def insert(
    grid: SurfelGrid, xy: np.ndarray, normals: np.ndarray, pose=(0.0, 0.0, 0.0), most=50.0, point_count=1.0
) -> None:
    insert_surfels(xy, normals, np.array(pose), grid, most, point_count, np.zeros(2), -1)


def random_points(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-math.pi, math.pi, count)
    normals = np.column_stack([np.cos(angle), np.sin(angle), rng.choice([0.0, 0.2, 1.0], count)])
    return rng.uniform(-4.0, 4.0, (count, 2)), normals


def to_map(xy: np.ndarray, pose: np.ndarray) -> np.ndarray:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return xy @ np.array([[c, s], [-s, c]]) + pose[:2]


def turned(normals: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return to_map(normals[:, :2], np.array([0.0, 0.0, pose[2]]))


def read_all(grid: SurfelGrid) -> list[tuple[float, float, float, float, float]]:
    """(mean x, mean y, normal x, normal y, count) of every surfel."""
    found = []
    for tile_row, tile_column in np.argwhere(grid.tiles.slots >= 0):
        slot = grid.tiles.slots[tile_row, tile_column]
        for row, column, side in np.argwhere(grid.surfels[slot, :, :, :, 0] > 0.0):
            n, x, y, nx, ny = grid.surfels[slot, row, column, side, :COSINES].astype(float)
            x += (((tile_column + grid.tiles.origin[1]) << TILE_BITS) + column + 0.5) * grid.cell_m
            y += (((tile_row + grid.tiles.origin[0]) << TILE_BITS) + row + 0.5) * grid.cell_m
            found.append((x, y, nx, ny, n))
    return found


def test_surfels_are_means_of_the_points_with_like_normals() -> None:
    xy, normals = random_points(6000)
    grid = empty_grid(cell_m=0.4)
    insert(grid, xy, normals, POSE, 1e6)
    expected: dict[tuple[int, int], list[list[np.ndarray]]] = {}
    facing: dict[tuple[int, int], list[np.ndarray]] = {}
    for point, normal, weight in zip(to_map(xy, POSE), turned(normals, POSE), normals[:, 2], strict=True):
        if weight < 1.0:
            continue
        key = math.floor(point[1] / 0.4), math.floor(point[0] / 0.4)
        members = expected.setdefault(key, [[], []])
        directions = facing.setdefault(key, [np.zeros(2), np.zeros(2)])
        cosines = [direction @ normal for direction in directions]
        side = 1 if members[0] and cosines[0] < 0.7 and (not members[1] or cosines[1] > cosines[0]) else 0
        merged = len(members[side]) * directions[side] + normal
        directions[side] = merged / np.hypot(*merged)
        members[side].append(point)
    for (row, column), sides in expected.items():
        slot = find_tile(grid.tiles, row >> TILE_BITS, column >> TILE_BITS)
        for side, members in enumerate(sides):
            surfel = grid.surfels[slot, row & TILE_MASK, column & TILE_MASK, side]
            assert surfel[0] == len(members)
            if members:
                centre = (np.array([column, row]) + 0.5) * 0.4
                np.testing.assert_allclose(surfel[1:3] + centre, np.mean(members, axis=0), atol=1e-5)
                np.testing.assert_allclose(surfel[3:5], facing[row, column][side], atol=1e-4)
    assert sum(n for *_, n in read_all(grid)) == np.count_nonzero(normals[:, 2] == 1.0)


def test_a_surfel_forgets_beyond_its_limit() -> None:
    grid, facing = empty_grid(), np.tile([-1.0, 0.0, 1.0], (100, 1))
    for x in (0.02, 0.06):
        insert(grid, np.tile([x, 0.05], (100, 1)), facing, most=10.0)
    ((x, _, _, _, count),) = read_all(grid)
    assert count == 10.0
    assert abs(x - 0.06) < 1e-3


def test_a_used_slot_is_cleared_before_it_is_filled() -> None:
    grid = empty_grid(used_slots=3)
    insert(grid, np.array([[0.05, 0.05]]), np.array([[1.0, 0.0, 1.0]]))
    assert [n for *_, n in read_all(grid)] == [1.0]


def test_the_wall_beside_a_point_is_by_the_surfels_near_it() -> None:
    """Between the plane through their mean and the mean of their own planes."""
    grid = empty_grid()
    insert(grid, *random_points(20_000, seed=2))
    surfels = np.array(read_all(grid))
    cells = np.floor(surfels[:, :2] / 0.1)
    cells_stored = np.round(cells)
    xy, normals = random_points(400, seed=3)
    found = np.empty((len(xy), 6))
    find_surfels(xy, normals, POSE, grid, 0.6, found)
    matched = 0
    for point, normal, weight, row in zip(
        to_map(xy, POSE), turned(normals, POSE), normals[:, 2], found, strict=True
    ):
        near = np.abs(cells_stored - np.floor(point / 0.1)).max(axis=1) <= 1.0
        near &= surfels[:, 2:4] @ normal > 0.6
        if weight == 0.0 or not near.any():
            assert row[4] == 0.0
            continue
        square = ((surfels[near, :2] - point) ** 2).sum(axis=1)
        weight = surfels[near, 4] * np.maximum(1.0 - square / (REACH_CELLS * 0.1) ** 2, 0.0) ** 2
        assert row[4] == pytest.approx(weight.sum(), abs=1e-5)
        if row[4] < 1e-3:
            continue
        mean = weight @ surfels[near, :4] / weight.sum()
        own_m = weight @ ((point - surfels[near, :2]) * surfels[near, 2:4]).sum(axis=1) / weight.sum()
        mean[2:] /= np.hypot(*mean[2:])
        mean[:2] -= ROUND_SHARE * (own_m - mean[2:] @ (point - mean[:2])) * mean[2:]
        np.testing.assert_allclose(row[:4], mean, atol=1e-4)
        matched += 1
    assert matched > 100


@pytest.mark.parametrize("radius_m", [0.25, 0.5, -0.5])
def test_a_round_wall_is_found_where_it_is(radius_m: float) -> None:
    """A column bulges, a niche (negative) recedes: the plane through the mean lies 6 and 3 mm off."""
    rng = np.random.default_rng(6)
    bearing = rng.uniform(0.0, 2.0 * math.pi, 40_000)
    outwards = np.column_stack([np.cos(bearing), np.sin(bearing)])
    xy = abs(radius_m) * outwards + rng.normal(0.0, 0.012, len(bearing))[:, None] * outwards
    facing = np.column_stack([math.copysign(1.0, radius_m) * outwards, np.ones(len(bearing))])
    insert(grid := empty_grid(), xy, facing, most=1e6)
    found = np.empty((len(xy), 6))
    find_surfels(xy, facing, np.zeros(3), grid, 0.6, found)
    off_m = ((xy - found[:, :2]) * found[:, 2:4]).sum(axis=1)
    assert abs(off_m.mean()) < 0.0005
    assert off_m.std() == pytest.approx(0.012, rel=0.15)


def test_points_that_lie_in_one_cell_one_behind_the_other_are_counted() -> None:
    grid = empty_grid()
    y = np.array([0.01, 0.05, 0.09, 0.11, 0.15, 0.31, 0.35, 0.02])
    xy = np.column_stack([np.full(8, 0.05), y])
    normals = np.tile([-1.0, 0.0, 1.0], (8, 1))
    insert(grid, xy, normals)
    found = np.empty((8, 6))
    find_surfels(xy, normals, np.zeros(3), grid, 0.6, found)
    np.testing.assert_array_equal(found[:, 5], [3, 3, 3, 2, 2, 2, 2, 1])


@pytest.mark.parametrize("rows", [4, 30, 4000])
def test_what_is_kept_of_a_search_changes_no_later_one(rows: int) -> None:
    """The pose moves by less and by more than a cell, and what is kept of the searches may not fit."""
    rng = np.random.default_rng(8)
    grid = empty_grid()
    xy = np.column_stack([np.linspace(-1.0, 1.0, 300), 0.5 + rng.normal(0.0, 0.02, 300)])
    normals = np.tile([0.0, -1.0, 1.0], (300, 1))
    insert(grid, xy, normals, POSE, 1000.0)
    around = empty_cache(len(xy))._replace(surfels=np.empty((SURFELS_AROUND + rows, 5)))
    for off in ((0.0, 0.0, 0.0), (0.004, -0.003, 0.001), (0.15, 0.02, 0.01), (0.004, -0.003, 0.001)):
        found, again = np.full((300, 6), np.nan), np.full((300, 6), np.nan)
        find_surfels(xy, normals, POSE + off, grid, 0.6, found)
        find_surfels_cached(xy, normals, POSE + off, grid, 0.6, 0.0, around, again)
        assert np.count_nonzero(found[:, 4]) > 200
        np.testing.assert_array_equal(again[:, 4:], found[:, 4:])
        np.testing.assert_array_equal(again[found[:, 4] > 0.0], found[found[:, 4] > 0.0])


def test_a_wall_of_too_few_points_is_ignored() -> None:
    grid, facing = empty_grid(), np.array([[-1.0, 0.0, 1.0]])
    wall = np.array([[0.05, 0.05]])
    for points in (1, 2):
        insert(grid, wall, facing)
        found = np.empty((1, 6))
        find_surfels_cached(wall, facing, np.zeros(3), grid, 0.6, 1.5, empty_cache(1), found)
        assert found[0, 4] == pytest.approx(points if points > 1.5 else 0.0)
