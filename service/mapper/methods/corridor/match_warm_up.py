"""The kernels of the default profile's matcher once, on an empty sub-map, so that they are compiled."""

from typing import get_type_hints

import numpy as np

from service.kernels.deskew import Returns
from service.kernels.match import MatchSettings, Prior, match_scan
from service.kernels.range_bias import see_bias, shorten_ranges
from service.kernels.static_score import Sightings, count_contradicting
from service.kernels.surfels import TILE_CELLS, SurfelGrid
from service.mapper.maps.tiles import Layer, TileMap, TilePool


def warm_up_match() -> None:
    """The match of a scan with all that it calls: a third of all compiling."""
    xy = np.zeros((1, 2))
    prior = Prior(np.zeros(3), np.zeros(3), np.eye(3), np.eye(3))
    settings = MatchSettings(*(kind(1) for kind in get_type_hints(MatchSettings).values()))
    returns = Returns(xy.copy(), np.zeros(1), np.zeros(1, np.int32))
    grid, normals = _empty_grid(), np.ones((1, 3))
    match_scan(returns, normals, prior, prior.pose.copy(), grid, settings, 1.0, xy)
    see_bias(xy, normals, np.zeros(3), np.zeros(2), grid, settings, 1.0, np.empty((2, 2)), np.empty(2))
    shorten_ranges(xy, np.zeros(2), np.zeros(2), 1.0, xy)
    tile = np.zeros((1, TILE_CELLS, TILE_CELLS))
    sightings = Sightings(tile.astype(np.int8), tile.astype(np.uint16))
    # a scan that fits needs it not
    count_contradicting(xy, np.zeros(2), normals, np.zeros(3), grid, sightings, 1.0)


def _empty_grid() -> SurfelGrid:
    layers = (Layer((TILE_CELLS, TILE_CELLS, 2, 5), np.float32), Layer((TILE_CELLS, TILE_CELLS), np.float32))
    pool = TilePool(layers, 1)
    surfels, field = pool.arrays
    return SurfelGrid(TileMap(pool).index(), surfels, field, 0.1)  # type: ignore[arg-type]
