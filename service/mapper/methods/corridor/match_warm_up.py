"""The kernels of the default profile's matcher once, on an empty sub-map, so that they are compiled."""

from typing import get_type_hints

import numpy as np

from service.kernels.deskew import Returns
from service.kernels.match import MatchSettings, Prior, match_scan
from service.kernels.surfels import COLUMNS, TILE_CELLS, SurfelGrid
from service.mapper.maps.tiles import Layer, TileMap, TilePool


def warm_up_match() -> None:
    """The match of a scan with all that it calls: a third of all compiling."""
    xy = np.zeros((1, 2))
    prior = Prior(np.zeros(3), np.zeros(3), np.eye(3), np.eye(3))
    settings = MatchSettings(*(kind(1) for kind in get_type_hints(MatchSettings).values()))
    returns = Returns(xy.copy(), np.zeros(1), np.zeros(1, np.int32))
    grid = _empty_grid()
    match_scan(returns, np.ones((1, 3)), prior, prior.pose.copy(), grid, grid, settings, 1.0, xy)


def _empty_grid() -> SurfelGrid:
    layers = (
        Layer((TILE_CELLS, TILE_CELLS, 2, COLUMNS), np.float32),
        Layer((TILE_CELLS, TILE_CELLS), np.float32),
    )
    pool = TilePool(layers, 1)
    surfels, field = pool.arrays
    return SurfelGrid(TileMap(pool).index(), surfels, field, 0.1)  # type: ignore[arg-type]
