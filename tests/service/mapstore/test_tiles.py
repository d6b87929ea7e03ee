import threading

import numpy as np
import pytest

from service.errors import StorageError
from service.mapstore.tiles import TileStore
from service.outputs import UNKNOWN
from tests.service.mapstore.tile_makers import CELL_M, EDGE, tile


def test_an_empty_store_has_no_version_and_no_grid():
    store = TileStore()
    assert (store.version, store.count, store.since(0), store.grid()) == (0, 0, [], None)


def test_a_newer_tile_replaces_and_an_older_one_does_not():
    store = TileStore()
    assert store.update([tile(0, 0, 5), tile(1, 0, 6)]) == 2
    assert store.update([tile(0, 0, 5), tile(0, 0, 4)]) == 0
    assert store.update([tile(0, 0, 7)]) == 1
    assert (store.version, store.count) == (7, 2)
    assert [(t.ix, t.version) for t in store.since(0)] == [(1, 6), (0, 7)]
    assert [(t.ix, t.version) for t in store.since(6)] == [(0, 7)]
    assert store.since(7) == []


def slow_grid(tiles):
    """The same picture cell by cell: (column, row), counted from the map's origin -> value."""
    return {
        (t.ix * EDGE + column, t.iy * EDGE + row): t.cells[row, column]
        for t in tiles
        for row in range(EDGE)
        for column in range(EDGE)
    }


@pytest.mark.parametrize("stretch", [(1, 1), (8, 0), (0, 8)])
def test_the_grid_agrees_with_painting_cell_by_cell_while_the_map_grows_on_all_sides(stretch):
    random = np.random.default_rng(7)
    store = TileStore()
    for version in range(1, 120, 3):
        reach = np.array(stretch) * (1 + version // 8)
        batch = [tile(*random.integers(-reach, reach + 1).tolist(), version + i) for i in range(3)]
        store.update([*batch, tile(900, 900, version, level=1)])
        grid = store.grid()
        assert grid is not None
        expected = slow_grid([t for t in store.since(0) if t.level == 0])
        left, low = round(grid.x_min_m / CELL_M), round(grid.y_min_m / CELL_M)
        painted = np.full(grid.cells.shape, UNKNOWN)
        for (column, row), value in expected.items():
            painted[row - low, column - left] = value
        np.testing.assert_array_equal(grid.cells, painted)
        columns, rows = zip(*expected, strict=True)
        assert grid.cells.shape == (max(rows) - min(rows) + 1, max(columns) - min(columns) + 1)
        assert grid.version == max(t.version for t in store.since(0) if t.level == 0)


def test_a_grid_given_out_never_changes():
    store = TileStore()
    store.update([tile(0, 0, 1, value=0)])
    first = store.grid()
    store.update([tile(0, 0, 2, value=100)])
    second = store.grid()
    assert first is not None
    assert second is not None
    assert (first.cells == 0).all()
    assert (second.cells == 100).all()
    with pytest.raises(ValueError, match="read-only"):
        second.cells[0, 0] = 1


def test_a_grid_is_not_made_anew_while_nothing_changes():
    store = TileStore()
    store.update([tile(0, 0, 1)])
    assert store.grid() is store.grid()


def test_a_tile_far_away_is_refused_as_a_picture_and_kept_as_a_tile():
    store = TileStore()
    store.update([tile(0, 0, 1), tile(10_000, 10_000, 2)])
    for _ in range(2):
        with pytest.raises(StorageError, match=r"spans 40004 x 40004 m, 6401280064 cells"):
            store.grid()
    assert len(store.since(0)) == 2


def test_tiles_of_another_cell_size_are_refused():
    store = TileStore()
    store.update([tile(0, 0, 1), tile(1, 0, 2, edge=16)])
    with pytest.raises(ValueError, match=r"\(16, 16\) cells of 0.5 m; this map has 8 x 8 of 0.5 m"):
        store.grid()


def test_updates_and_pictures_from_two_threads_end_in_the_same_map():
    store = TileStore()
    done = threading.Event()

    def paint() -> None:
        while not done.is_set():
            store.grid()

    painter = threading.Thread(target=paint)
    painter.start()
    for version in range(1, 400):
        store.update([tile(version % 11 - 5, version % 7 - 3, version, value=version % 101)])
    done.set()
    painter.join(timeout=10.0)
    assert not painter.is_alive()
    grid = store.grid()
    assert grid is not None
    for t in store.since(0):
        row, column = (t.iy + 3) * EDGE, (t.ix + 5) * EDGE
        assert (grid.cells[row : row + EDGE, column : column + EDGE] == t.cells[0, 0]).all()
