import numpy as np
import pytest

from service.errors import StorageError
from service.mapstore.picture import picture_of_grid, picture_of_tiles, to_pixels
from service.mapstore.tiles import TileStore
from tests.service.mapstore.tile_makers import tile


def test_occupancy_becomes_black_white_and_grey_at_the_thresholds_of_ros():
    cells = np.arange(-1, 101, dtype=np.int8).reshape(1, -1)
    pixels = to_pixels(cells)[0]
    grey = dict(zip(cells[0].tolist(), pixels.tolist(), strict=True))
    assert grey[-1] == 205
    assert {grey[v] for v in range(20)} == {254}
    assert {grey[v] for v in range(20, 65)} == {205}
    assert {grey[v] for v in range(65, 101)} == {0}


def test_the_first_row_of_pixels_is_the_largest_y():
    cells = np.array([[0, 0], [100, 0]], dtype=np.int8)
    assert to_pixels(cells).tolist() == [[0, 254], [254, 254]]


def test_tiles_and_the_grid_made_of_them_give_the_same_picture():
    store = TileStore()
    store.update([tile(-2, 1, 1), tile(0, 0, 2), tile(1, -3, 3), tile(5, 5, 4, level=1)])
    by_tiles, by_grid = picture_of_tiles(store.since(0)), picture_of_grid(store.grid())
    assert (by_tiles.width, by_tiles.height) == (by_grid.width, by_grid.height) == (32, 40)
    assert (by_tiles.x_min_m, by_tiles.y_min_m) == (by_grid.x_min_m, by_grid.y_min_m) == (-8.0, -12.0)
    for _ in range(2):  # twice: PGM, then PNG
        np.testing.assert_array_equal(np.vstack(list(by_tiles.bands())), np.vstack(list(by_grid.bands())))


def test_a_map_that_ran_away_makes_no_picture():
    with pytest.raises(StorageError, match="has the pose run away"):
        picture_of_tiles([tile(0, 0, 1), tile(40_000, 40_000, 2)])
