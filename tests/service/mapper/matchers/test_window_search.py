import math

import numpy as np
import pytest

from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_search import search_exhaustive
from service.kernels.surfels import TILE_BITS, TILE_CELLS
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from service.mapper.matchers.window_search import layer_of, search_bounded, thinned, window_around

CELL_M = 0.1


def random_field() -> LikelihoodField:
    """Likelihoods 6.4 m around the origin, and no tile beyond."""
    pool = TilePool((Layer((TILE_CELLS, TILE_CELLS), np.float32),), 64)
    tiles = TileMap(pool)
    tiles.cover_around((0.0, 0.0), 0.5, CELL_M, TILE_BITS)
    noise = np.random.default_rng(2)
    for row in (-1, 0):
        for column in (-1, 0):
            slot, _ = tiles.take(row, column)
            pool.arrays[0][slot] = noise.random((TILE_CELLS, TILE_CELLS), np.float32)
    return LikelihoodField(tiles.index(), pool.arrays[0], CELL_M)  # type: ignore[arg-type]


@pytest.mark.parametrize(("count", "most", "left"), [(541, 180, 181), (541, 1000, 541), (9, 4, 5)])
def test_points_are_thinned_to_about_as_many_as_asked_for(count: int, most: int, left: int) -> None:
    xy = np.arange(2.0 * count).reshape(-1, 2)
    thin = thinned(xy, most)
    assert len(thin) == left
    np.testing.assert_array_equal(thin[1], xy[max(1, count // most)])
    assert thin.flags.c_contiguous


def test_a_bounded_search_without_a_least_score_finds_what_asking_all_finds() -> None:
    layer = layer_of(random_field())
    xy = np.random.default_rng(3).uniform(-2.0, 2.0, (60, 2))
    window = window_around(np.array([0.3, -0.2, 0.4]), (1.0, 0.3), layer, 0.05)
    best, _ = search_exhaustive(xy, layer, window)
    found = search_bounded(xy, layer, window)
    np.testing.assert_array_equal(found.pose, best.pose)
    assert found.score == best.score
    assert search_bounded(xy, layer, window, best.score + 1e-3).score == -math.inf
