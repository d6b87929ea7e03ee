import math

import numpy as np
import pytest

from service.kernels import line_likelihood
from service.kernels.likelihood_search import LikelihoodLayer
from service.kernels.line_likelihood import monte_carlo_search, rasterise_scan, smooth_lines
from service.kernels.tiles import TileIndex
from tests.service.kernels.inner import from_python

mean_value = from_python(line_likelihood.mean_value)

LEVELS = np.array([9, 6, 3], np.uint8)
CELL_M = 0.1


def empty_layer(tiles: int = 3, tile_cells: int = 20) -> LikelihoodLayer:
    """tiles x tiles tiles from cell (0, 0) on, all empty."""
    slots = np.arange(tiles * tiles, dtype=np.int32).reshape(tiles, tiles)
    index = TileIndex(slots, np.zeros(2, np.int64), np.empty(0, np.int32), np.array([0, tiles * tiles]))
    cells = np.zeros((tiles * tiles, tile_cells, tile_cells), np.uint8)
    return LikelihoodLayer(index, cells, 0.0, 0.1, 0.1, CELL_M)


def cells_of(layer: LikelihoodLayer) -> np.ndarray:
    return np.block([[layer.cells[slot] for slot in row] for row in layer.tiles.slots])


def draw(
    layer: LikelihoodLayer, xy: list[tuple[float, float]], ring_cells: int = 1, join_m: float = 0.15
) -> None:
    beam = np.arange(len(xy), dtype=np.int32)
    changed = np.zeros(len(layer.cells), np.uint8)
    rasterise_scan(np.array(xy), beam, layer, changed, LEVELS, ring_cells, np.full(len(xy), join_m))
    assert (changed > 0).tolist() == [bool(cells.any()) for cells in layer.cells]


# C9
@pytest.mark.parametrize(
    "place", [(1.05, 1.05), (2.05, 2.05), (1.95, 3.95)]
)  # inside a tile, and over borders
def test_a_point_is_a_hit_and_two_rings(place: tuple[float, float]) -> None:
    layer = empty_layer()
    draw(layer, [place])
    row, column = math.floor(place[1] / CELL_M), math.floor(place[0] / CELL_M)
    expected = np.zeros((60, 60), np.uint8)
    for reach, level in ((2, 3), (1, 6), (0, 9)):
        expected[row - reach : row + reach + 1, column - reach : column + reach + 1] = level
    np.testing.assert_array_equal(cells_of(layer), expected)


# C10
def test_neighbours_are_joined_by_a_line_and_distant_ones_are_not() -> None:
    joined, apart, broken = empty_layer(), empty_layer(), empty_layer()
    ends = [(1.05, 1.05), (2.05, 1.55)]
    draw(joined, ends, join_m=1.2)
    draw(apart, ends, join_m=1.0)
    beams = np.array([0, 2], np.int32)  # the beam between had no return
    rasterise_scan(np.array(ends), beams, broken, np.zeros(9, np.uint8), LEVELS, 1, np.full(2, 1.2))
    hits = np.argwhere(cells_of(joined) == 9)
    assert len(hits) == 11
    assert np.abs(np.diff(hits, axis=0)).max() == 1
    assert np.abs((hits[:, 0] - 10) - 0.5 * (hits[:, 1] - 10)).max() <= 1.0
    for layer in (apart, broken):
        assert (cells_of(layer) == 9).sum() == 2


def test_smoothing_takes_noise_off_a_wall_and_leaves_its_ends() -> None:
    noise = np.random.default_rng(1)
    x = np.arange(0.0, 4.0, 0.05)
    rough = np.stack([x, 0.04 * noise.standard_normal(len(x))], axis=1)
    smooth = np.empty_like(rough)
    smooth_lines(rough, np.arange(len(x), dtype=np.int32), np.full(len(x), 0.5), 0.3, smooth)
    assert smooth[8:-8, 1].std() < 0.5 * rough[8:-8, 1].std()
    np.testing.assert_array_equal(smooth[[0, -1]], rough[[0, -1]])
    apart = np.empty_like(rough)
    smooth_lines(rough, np.arange(len(x), dtype=np.int32), np.full(len(x), 0.01), 0.3, apart)
    np.testing.assert_array_equal(apart, rough)


# C34
def test_the_climb_by_chance_ends_higher_than_it_began() -> None:
    layer = empty_layer()
    draw(layer, [(1.05, 1.05), (1.05, 4.05), (4.05, 4.05), (4.05, 1.05)], join_m=4.0)
    xy = np.ascontiguousarray(np.argwhere(cells_of(layer) == 9)[:, ::-1] * CELL_M + 0.05 - 2.5)
    start = np.array([2.62, 2.4, 0.05])
    deviates = np.random.default_rng(1).standard_normal((900, 3))
    pose, value, trials = monte_carlo_search(xy, layer, start, deviates, 0.1, 0.1)
    assert value > mean_value(xy, start, layer)
    assert value == mean_value(xy, pose, layer)
    assert np.abs(pose - (2.5, 2.5, 0.0)).max() < 0.1
    assert 300 <= trials <= 900


# C9 C11
def test_the_greater_value_stays_and_nothing_is_ever_forgotten() -> None:
    layer = empty_layer()
    draw(layer, [(1.05, 1.05)])
    before = cells_of(layer).copy()
    draw(layer, [(1.15, 1.05)])
    after = cells_of(layer)
    assert (after >= before).all()
    assert after[10, 10:14].tolist() == [9, 9, 6, 3]
