import logging
import pickle

import numpy as np
import pytest

from service.geometry.grid import TileRange
from service.kernels import tiles as tile_kernels
from service.kernels.tiles import NO_TILE, take_slot
from service.mapper.maps.tiles import Layer, TileMap, TilePool
from tests.service.kernels.inner import from_python

find_tile = from_python(tile_kernels.find_tile)

LAYERS = (Layer((4, 4), np.float32), Layer((), np.uint8))


def at(row: int, column: int) -> TileRange:
    return TileRange(row, column, row, column)


def put(tile_map: TileMap, row: int, column: int, value: float) -> int:
    tile_map.cover(at(row, column))
    slot, used_before = take_slot(tile_map.index(), row, column)
    if used_before:
        tile_map.pool.arrays[0][slot] = 0.0
    tile_map.pool.arrays[0][slot] += value
    return int(slot)


def read(tile_map: TileMap, row: int, column: int) -> float:
    slot = find_tile(tile_map.index(), row, column)
    return float("nan") if slot == NO_TILE else float(tile_map.pool.arrays[0][slot, 0, 0])


def test_a_map_grows_in_all_directions_without_moving_a_cell() -> None:
    pool = TilePool(LAYERS, 5000)
    tile_map = TileMap(pool)
    cells_at = pool.arrays[0].ctypes.data
    places = {}
    for k, (row, column) in enumerate([(0, 0), (3, 0), (0, -7), (-20, 1), (40, 33), (-5, -60), (1, 1)]):
        places[row, column] = put(tile_map, row, column, float(k + 1))
    assert pool.arrays[0].ctypes.data == cells_at
    for k, ((row, column), slot) in enumerate(places.items()):
        assert find_tile(tile_map.index(), row, column) == slot
        assert read(tile_map, row, column) == k + 1
    assert {(row, column): slot for row, column, slot in tile_map.tiles()} == places
    assert np.isnan(read(tile_map, 2, 2))


def test_a_pickled_map_is_the_same_and_weighs_what_its_tiles_do() -> None:
    tile_map = TileMap(TilePool(LAYERS, 1 << 20))
    slots = [put(tile_map, 0, column, float(column)) for column in range(6)]
    tile_map.pool.release(np.array(slots[2:4], np.int32))
    pickled = pickle.dumps(tile_map)
    assert len(pickled) < 4000
    again = pickle.loads(pickled)
    assert [read(again, 0, column) for column in range(6)] == [float(column) for column in range(6)]
    assert again.pool.capacity == tile_map.pool.capacity
    assert put(again, 9, 9, 1.0) == put(tile_map, 9, 9, 1.0) == slots[3]
    assert put(again, 9, 8, 1.0) == put(tile_map, 9, 8, 1.0) == slots[2]
    assert put(again, 9, 7, 1.0) == put(tile_map, 9, 7, 1.0) == 6


def test_a_pool_that_is_used_up_doubles_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    pool = TilePool(LAYERS, 4)
    tile_map = TileMap(pool)
    with caplog.at_level(logging.WARNING):
        for column in range(9):
            put(tile_map, 0, column, float(column))
    assert pool.capacity >= 9
    assert "used up" in caplog.text
    assert [read(tile_map, 0, column) for column in range(9)] == list(range(9))
