import numpy as np
from scipy.ndimage import map_coordinates

from service.kernels import surfels
from service.kernels.likelihood import SPLAT_REACH_CELLS, LikelihoodField, read_field, splat_likelihood
from service.kernels.surfels import TILE_BITS, TILE_CELLS, SurfelGrid
from tests.service.kernels.grids import empty_grid
from tests.service.kernels.inner import from_python

touch_tile = from_python(surfels.touch_tile)

POSE = np.array([0.3, -0.4, 0.7])
CELL_M = 0.1


def whole_field(grid: SurfelGrid) -> np.ndarray:
    """field[row, column] of all tiles; the lower left corner of [0, 0] lies at the first tile's."""
    tiles = grid.tiles.slots
    field = np.zeros((tiles.shape[0] * TILE_CELLS, tiles.shape[1] * TILE_CELLS), np.float32)
    for row, column in np.argwhere(tiles >= 0):
        field[row << TILE_BITS : (row + 1) << TILE_BITS, column << TILE_BITS : (column + 1) << TILE_BITS] = (
            grid.field[tiles[row, column]]
        )
    return field


def to_map(xy: np.ndarray) -> np.ndarray:
    c, s = np.cos(POSE[2]), np.sin(POSE[2])
    return xy @ np.array([[c, s], [-s, c]]) + POSE[:2]


def test_splats_agree_with_the_gaussian_of_the_nearest_point() -> None:
    xy = np.random.default_rng(1).uniform(-3.0, 3.0, (60, 2))
    grid = empty_grid(used_slots=2)
    splat_likelihood(xy, POSE, grid, 0.15, 2.0)
    half = grid.tiles.slots.shape[0] // 2 * TILE_CELLS
    centres = (np.arange(2 * half) - half + 0.5) * CELL_M
    expected = np.zeros((2 * half, 2 * half))
    for x, y in to_map(xy):
        gaussian = np.exp(-((centres[:, None] - y) ** 2 + (centres[None, :] - x) ** 2) / (2 * 0.15**2))
        row, column = int(np.floor(y / CELL_M)) + half, int(np.floor(x / CELL_M)) + half
        window = np.zeros_like(gaussian, dtype=bool)
        reach = SPLAT_REACH_CELLS
        window[row - reach : row + reach + 1, column - reach : column + reach + 1] = True
        expected = np.maximum(expected, gaussian * window)
    np.testing.assert_allclose(whole_field(grid), expected, atol=1e-6)


def random_field() -> SurfelGrid:
    grid = empty_grid(half_tiles=2)
    for row in range(-2, 2):
        for column in range(-2, 2):
            touch_tile(grid, row, column)
    grid.field[:] = np.random.default_rng(2).random(grid.field.shape, np.float32)
    return grid


def field_of(grid: SurfelGrid) -> LikelihoodField:
    return LikelihoodField(grid.tiles, grid.field, grid.cell_m)


def test_the_field_is_read_as_scipy_reads_it() -> None:
    grid = random_field()
    xy = np.random.default_rng(3).uniform(-3.5, 3.5, (500, 2))
    values = np.empty((500, 3))
    read_field(xy, POSE, field_of(grid), values)
    half = 2 * TILE_CELLS
    cells = (to_map(xy) / CELL_M - 0.5 + half)[:, ::-1].T
    expected = map_coordinates(whole_field(grid).astype(float), cells, order=1)
    np.testing.assert_allclose(values[:, 0], expected, atol=1e-6)


def test_nothing_is_likely_where_no_tile_is() -> None:
    values = np.full((5, 3), 7.0)
    read_field(np.full((5, 2), 1e4), np.zeros(3), field_of(random_field()), values)
    np.testing.assert_array_equal(values, 0.0)
