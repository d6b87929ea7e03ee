"""The search of a lost scan once, on an empty map, so that it is compiled: a short drive is never lost."""

import numpy as np

from service.geometry.se2 import SE2
from service.kernels.likelihood_search import LikelihoodLayer
from service.kernels.surfels import TILE_CELLS
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from service.mapper.matchers.recovery import search_around


def warm_up_search() -> None:
    """On a map of floats."""
    _search(np.float32)


def warm_up_byte_search() -> None:
    """On a map of bytes."""
    _search(np.uint8)


def _search(cell: type[np.float32 | np.uint8]) -> None:
    pool = TilePool((Layer((TILE_CELLS, TILE_CELLS), cell),), 1)
    layer = LikelihoodLayer(TileMap(pool).index(), pool.arrays[0], 0.0, 0.0, 1.0, 0.1)  # type: ignore[arg-type]
    search_around(np.zeros((1, 2)), SE2(), (0.1, 0.1), layer)
