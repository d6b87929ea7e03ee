import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.kernels import likelihood_search
from service.kernels.branch_and_bound import MaxPyramid, build_pyramid, padding_cells, search_branch_and_bound
from service.kernels.likelihood_search import (
    LikelihoodLayer,
    SearchWindow,
    search_exhaustive,
    surface_moments,
)
from service.kernels.tiles import TileIndex
from tests.service.kernels.inner import from_python

score_window = from_python(likelihood_search.score_window)

CELL_M = 0.1


def tiled(
    field: np.ndarray, first_row: int, first_column: int, tile_cells: int, empty: float
) -> LikelihoodLayer:
    """A field whose cell [0, 0] is (first_row, first_column), in tiles; those all `empty` are left out."""
    rows = (first_row // tile_cells, (first_row + field.shape[0] - 1) // tile_cells)
    columns = (first_column // tile_cells, (first_column + field.shape[1] - 1) // tile_cells)
    slots = np.full((rows[1] - rows[0] + 1, columns[1] - columns[0] + 1), -1, np.int32)
    padded = np.full([n * tile_cells for n in slots.shape], empty, field.dtype)
    r, c = first_row - rows[0] * tile_cells, first_column - columns[0] * tile_cells
    padded[r : r + field.shape[0], c : c + field.shape[1]] = field
    pool = []
    for a, b in np.ndindex(*slots.shape):
        tile = padded[a * tile_cells : (a + 1) * tile_cells, b * tile_cells : (b + 1) * tile_cells]
        if (tile != empty).any():
            slots[a, b] = len(pool)
            pool.append(tile)
    index = TileIndex(
        slots, np.array([rows[0], columns[0]]), np.empty(len(pool), np.int32), np.zeros(2, np.int64)
    )
    return LikelihoodLayer(index, np.ascontiguousarray(pool), empty, 0.1, 0.005, CELL_M)


def pyramid_of(
    layer: LikelihoodLayer, shape: tuple[int, int], corner: tuple[int, int], count: int
) -> MaxPyramid:
    pad = padding_cells(count)
    levels = np.empty((count, shape[0] + pad, shape[1] + pad), layer.cells.dtype)
    return build_pyramid(layer, corner[0] - pad, corner[1] - pad, levels)


def by_hand(xy: np.ndarray, field: np.ndarray, corner: tuple[int, int], window: SearchWindow):
    """Every candidate in plain loops, in the unit of the cells."""
    sums = np.zeros((2 * window.half_theta + 1, 2 * window.half_y + 1, 2 * window.half_x + 1))
    for k, j, i in np.ndindex(*sums.shape):
        theta = window.pose[2] + (k - window.half_theta) * window.theta_step_rad
        for x, y in xy:
            px = window.pose[0] + math.cos(theta) * x - math.sin(theta) * y
            py = window.pose[1] + math.sin(theta) * x + math.cos(theta) * y
            row = math.floor(py / CELL_M) + j - window.half_y - corner[0]
            column = math.floor(px / CELL_M) + i - window.half_x - corner[1]
            if 0 <= row < field.shape[0] and 0 <= column < field.shape[1]:
                sums[k, j, i] += field[row, column]
    return sums


def random_case(seed: int, dtype: type, sparse: bool = True):
    noise = np.random.default_rng(seed)
    corner = tuple(noise.integers(-40, 10, 2).tolist())
    field = noise.integers(0, 180, (60, 70)) * (noise.random((60, 70)) < (0.05 if sparse else 1.0))
    field = field.astype(dtype) * dtype(1 if dtype is np.uint8 else 0.37)  # sums of the latter are rounded
    xy = np.repeat(
        noise.uniform(-2.5, 2.5, (30, 2)), noise.integers(1, 3, 30), axis=0
    )  # some twice in a cell
    pose = np.array([*noise.uniform(-1.0, 2.0, 2), noise.uniform(-math.pi, math.pi)])
    window = SearchWindow(pose, int(noise.integers(0, 12)), int(noise.integers(0, 12)), 4, 0.02)
    return field, corner, tiled(field, *corner, 16, 0.0), xy, window


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_every_candidate_is_scored_as_by_hand(dtype) -> None:
    for seed in range(2):
        field, corner, layer, xy, window = random_case(seed, dtype)
        sums = score_window(xy, layer, window)
        np.testing.assert_allclose(sums, by_hand(xy, field, corner, window), rtol=1e-5, atol=1e-4)


# C8
@given(seed=st.integers(0, 10**6), levels=st.integers(1, 5), dtype=st.sampled_from([np.uint8, np.float32]))
def test_branch_and_bound_finds_what_asking_every_candidate_finds(seed, levels, dtype) -> None:
    sparse = seed % 3 > 0
    field, corner, layer, xy, window = random_case(seed, dtype, sparse)
    expected, _ = search_exhaustive(xy, layer, window)
    pyramid = pyramid_of(layer, field.shape, corner, levels)
    found = search_branch_and_bound(xy, pyramid, window, -math.inf)
    assert (found.k, found.j, found.i) == (expected.k, expected.j, expected.i)
    assert found.score == expected.score


@pytest.mark.parametrize("value", [0, 50])
def test_among_equals_both_searches_take_the_one_nearest_the_centre(value: int) -> None:
    field = np.full((60, 70), value, np.uint8)
    layer = tiled(field, -30, -35, 16, float(255 if value == 0 else 0))
    window = SearchWindow(np.zeros(3), 5, 6, 3, 0.02)
    xy = np.random.default_rng(1).uniform(-1.0, 1.0, (30, 2))
    flat, _ = search_exhaustive(xy, layer, window)
    bounded = search_branch_and_bound(xy, pyramid_of(layer, field.shape, (-30, -35), 3), window, -9.0)
    assert (flat.k, flat.j, flat.i) == (bounded.k, bounded.j, bounded.i) == (3, 6, 5)


def test_moments_of_a_gaussian_surface_are_its_own() -> None:
    covariance = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, -0.2], [0.1, -0.2, 1.5]])
    grid = np.stack(np.mgrid[-9:10, -9:10, -9:10], axis=-1)[..., ::-1] - np.array([0.4, 0.2, -0.3])
    sums = -0.5 * np.einsum("...a,ab,...b", grid, np.linalg.inv(covariance), grid).astype(np.float32)
    mean, moments = surface_moments(3.0 * sums, float(3.0 * sums.max()), 3.0)
    np.testing.assert_allclose(mean, [9.4, 9.2, 8.7], atol=1e-3)
    np.testing.assert_allclose(moments, covariance, atol=1e-3)
