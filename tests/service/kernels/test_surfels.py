import math

import numpy as np
import pytest

from service.kernels import surfels, tiles
from service.kernels.surfels import (
    COSINES,
    MEAN_X,
    MEAN_Y,
    REACH_CELLS,
    ROUND_SHARE,
    SURFELS_AROUND,
    TILE_BITS,
    TILE_MASK,
    SurfelGrid,
    insert_surfels,
    shorten_surfels,
)
from tests.service.kernels.inner import from_python
from tests.service.kernels.surfel_grids import empty_grid

find_surfels = from_python(surfels.find_surfels)
find_tile = from_python(tiles.find_tile)

find_surfels_cached = from_python(surfels.find_surfels_cached)
empty_cache = from_python(surfels.empty_cache)
POSE = np.array([0.3, -0.4, 0.7])


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
    insert_surfels(xy, normals, POSE, grid, 1e6, 1.0, np.zeros(2), -1)
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


def test_a_thin_wall_keeps_two_sides() -> None:
    grid = empty_grid()
    y = np.linspace(-0.5, 0.5, 50)
    for x, facing in ((0.02, -1.0), (0.07, 1.0)):
        xy = np.column_stack([np.full(50, x), y])
        insert_surfels(
            xy, np.tile([facing, 0.0, 1.0], (50, 1)), np.zeros(3), grid, 50.0, 1.0, np.zeros(2), -1
        )
    means = {round(nx): [x for x, _, n, _, _ in read_all(grid) if n == nx] for nx in (-1.0, 1.0)}
    np.testing.assert_allclose(means[-1], 0.02, atol=1e-6)
    np.testing.assert_allclose(means[1], 0.07, atol=1e-6)


def test_a_surfel_forgets_beyond_its_limit() -> None:
    grid = empty_grid()
    for x, times in ((0.02, 100), (0.06, 60)):
        xy = np.tile([x, 0.05], (times, 1))
        insert_surfels(
            xy, np.tile([-1.0, 0.0, 1.0], (times, 1)), np.zeros(3), grid, 10.0, 1.0, np.zeros(2), -1
        )
    ((x, _, _, _, count),) = read_all(grid)
    assert count == 10.0
    assert abs(x - 0.06) < 1e-3


def of_fine_and_noisy_points(times: int, most: float) -> tuple[float, float]:
    """x and count of the surfel of points at 0.02 m, then of as many at 0.06 m with four times the noise."""
    grid, facing = empty_grid(), np.tile([-1.0, 0.0, 1.0], (times, 1))
    insert_surfels(np.tile([0.02, 0.05], (times, 1)), facing, np.zeros(3), grid, most, 1.0, np.zeros(2), -1)
    insert_surfels(
        np.tile([0.06, 0.05], (times, 1)), facing, np.zeros(3), grid, most, 1.0 / 16.0, np.zeros(2), -1
    )
    ((x, _, _, _, count),) = read_all(grid)
    return x, count


def test_points_count_by_the_inverse_of_their_variance() -> None:
    x, count = of_fine_and_noisy_points(32, most=1e3)
    assert count == 34.0
    assert x == pytest.approx((32 * 0.02 + 2 * 0.06) / 34.0, abs=1e-6)


def test_noisy_points_reduce_no_surfel_of_more_points() -> None:
    """A limit of ten points of theirs is not one of ten points of a laser that knows four times better."""
    x, count = of_fine_and_noisy_points(20, most=10.0)
    assert count == 10.0
    assert x == pytest.approx(0.06 - 0.04 * (1.0 - 1.0 / 160.0) ** 20, abs=1e-6)


def test_a_used_slot_is_cleared_before_it_is_filled() -> None:
    grid = empty_grid(used_slots=3)
    insert_surfels(
        np.array([[0.05, 0.05]]), np.array([[1.0, 0.0, 1.0]]), np.zeros(3), grid, 50.0, 1.0, np.zeros(2), -1
    )
    assert [n for *_, n in read_all(grid)] == [1.0]


def test_a_corner_keeps_its_two_walls_apart() -> None:
    grid = empty_grid()
    rng = np.random.default_rng(6)
    across, along = 0.05 + rng.normal(0.0, 0.005, 200), rng.uniform(0.0, 0.1, 200)
    tilt = rng.normal(0.0, 0.1, 200)
    facing = np.column_stack([-np.cos(tilt), np.sin(tilt), np.ones(200)])
    insert_surfels(np.column_stack([across, along]), facing, np.zeros(3), grid, 1e3, 1.0, np.zeros(2), -1)
    insert_surfels(
        np.column_stack([along, across]),
        np.ascontiguousarray(facing[:, [1, 0, 2]]),
        np.zeros(3),
        grid,
        1e3,
        1.0,
        np.zeros(2),
        -1,
    )
    found = sorted(row for row in read_all(grid) if row[4] > 20)
    normals_found = sorted(row[2:4] for row in found)
    np.testing.assert_allclose(normals_found, [[-1.0, 0.0], [0.0, -1.0]], atol=0.05)


def test_a_wall_that_runs_along_a_border_of_cells_is_found_where_it_is() -> None:
    """Its points fall to both sides, a few more to one: the mean of the nearest surfel would lean there."""
    rng = np.random.default_rng(5)
    for wall_y_m in (0.2, 0.205, 0.215):
        y = wall_y_m + rng.normal(0.0, 0.012, 20_000)
        insert_surfels(
            np.column_stack([rng.uniform(0.0, 1.0, 20_000), y]),
            np.tile([0.0, -1.0, 1.0], (20_000, 1)),
            np.zeros(3),
            grid := empty_grid(),
            1e6,
            1.0,
            np.zeros(2),
            -1,
        )
        xy = np.column_stack([np.linspace(0.2, 0.8, 50), wall_y_m + rng.normal(0.0, 0.012, 50)])
        found = np.empty((50, 6))
        find_surfels(xy, np.tile([0.0, -1.0, 1.0], (50, 1)), np.zeros(3), grid, 0.6, found)
        np.testing.assert_allclose(found[:, 1], wall_y_m, atol=0.003)


def test_the_wall_beside_a_point_is_by_the_surfels_near_it() -> None:
    """Between the plane through their mean and the mean of their own planes."""
    grid = empty_grid()
    insert_surfels(*random_points(20_000, seed=2), np.zeros(3), grid, 50.0, 1.0, np.zeros(2), -1)
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
    bearing = rng.uniform(0.0, 2.0 * math.pi, 200_000)
    outwards = np.column_stack([np.cos(bearing), np.sin(bearing)])
    xy = abs(radius_m) * outwards + rng.normal(0.0, 0.012, len(bearing))[:, None] * outwards
    facing = np.column_stack([math.copysign(1.0, radius_m) * outwards, np.ones(len(bearing))])
    insert_surfels(xy, facing, np.zeros(3), grid := empty_grid(), 1e6, 1.0, np.zeros(2), -1)
    found = np.empty((len(xy), 6))
    find_surfels(xy, facing, np.zeros(3), grid, 0.6, found)
    off_m = ((xy - found[:, :2]) * found[:, 2:4]).sum(axis=1)
    assert abs(off_m.mean()) < 0.0005
    assert off_m.std() == pytest.approx(0.012, rel=0.15)


def test_far_from_the_origin_nothing_is_lost() -> None:
    far = np.array([-12.75, 9.6, 0.0])
    xy, normals = random_points(3000, seed=4)
    near_grid, far_grid = empty_grid(tiles_each_way=8), empty_grid(tiles_each_way=8)
    insert_surfels(xy, normals, np.zeros(3), near_grid, 50.0, 1.0, np.zeros(2), -1)
    insert_surfels(xy, normals, far, far_grid, 50.0, 1.0, np.zeros(2), -1)
    moved = np.array(sorted(read_all(far_grid)))
    assert len(moved) > 100
    total = np.array([(x * n, y * n, n) for x, y, _, _, n in read_all(near_grid)]).sum(axis=0)
    moved_total = np.array([(x * n, y * n, n) for x, y, _, _, n in moved]).sum(axis=0)
    assert total[2] == moved_total[2]
    np.testing.assert_allclose(moved_total[:2] / total[2] - total[:2] / total[2], far[:2], atol=1e-4)


def test_points_that_lie_in_one_cell_one_behind_the_other_are_counted() -> None:
    grid = empty_grid()
    y = np.array([0.01, 0.05, 0.09, 0.11, 0.15, 0.31, 0.35, 0.02])
    xy = np.column_stack([np.full(8, 0.05), y])
    normals = np.tile([-1.0, 0.0, 1.0], (8, 1))
    insert_surfels(xy, normals, np.zeros(3), grid, 50.0, 1.0, np.zeros(2), -1)
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
    insert_surfels(xy, normals, POSE, grid, 1000.0, 1.0, np.zeros(2), -1)
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
        insert_surfels(wall, facing, np.zeros(3), grid, 50.0, 1.0, np.zeros(2), -1)
        found = np.empty((1, 6))
        find_surfels_cached(wall, facing, np.zeros(3), grid, 0.6, 1.5, empty_cache(1), found)
        assert found[0, 4] == pytest.approx(points if points > 1.5 else 0.0)


def test_a_surfel_keeps_the_mean_cosine_of_each_laser_and_gives_its_ranges_back() -> None:
    """Two points of laser 0, head-on and at 60 deg, one of laser 1: their wall moves by a share of a step."""
    grid, facing = empty_grid(), np.array([[-1.0, 0.0, 1.0]])
    wall = np.array([[0.05, 0.05]])
    for laser, sensor in ((0, (-1.0, 0.05)), (0, (-0.45, 0.05 - 0.5 * math.sqrt(3.0))), (1, (-1.0, 0.05))):
        insert_surfels(wall, facing, np.zeros(3), grid, 50.0, 1.0, np.array(sensor), laser)
    slot = grid.tiles.slots[-grid.tiles.origin[0], -grid.tiles.origin[1]]
    surfel = grid.surfels[slot, 0, 0, 0]
    np.testing.assert_allclose(surfel[COSINES:], [1.5 / 3.0, 1.0 / 3.0, 0.0], atol=1e-6)
    shorten_surfels(grid, 0, 0.03)
    np.testing.assert_allclose(surfel[MEAN_X : MEAN_Y + 1], [-0.015, 0.0], atol=1e-7)
