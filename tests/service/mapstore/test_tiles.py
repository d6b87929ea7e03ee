import threading

import numpy as np
import pytest

from service.errors import StorageError
from service.mapstore.tiles import TileStore
from service.outputs import UNKNOWN
from tests.in_background import in_background
from tests.service.mapstore.tile_makers import CELL_M, EDGE, GEO, tile


def test_an_empty_store_has_no_version_and_no_grid():
    store = TileStore()
    assert (store.version, store.since(0), store.grid()) == (0, [], None)


def test_a_newer_tile_replaces_and_an_older_one_does_not():
    store = TileStore()
    assert store.update([tile(0, 0, 5), tile(1, 0, 6)]) == 2
    assert store.update([tile(0, 0, 5), tile(0, 0, 4)]) == 0
    assert store.update([tile(0, 0, 7)]) == 1
    assert (store.version, len(store.since(0))) == (7, 2)
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
def test_the_grid_agrees_with_rendering_cell_by_cell_while_the_map_grows_on_all_sides(stretch):
    random = np.random.default_rng(7)
    store = TileStore()
    for version in range(1, 120, 3):
        reach = np.array(stretch) * (1 + version // 8)
        batch = [tile(*random.integers(-reach, reach + 1).tolist(), version + i) for i in range(3)]
        store.update([*batch, tile(900, 900, version, level=1)])
        grid = store.grid()
        expected = slow_grid([t for t in store.since(0) if t.level == 0])
        left, low = round(grid.x_min_m / CELL_M), round(grid.y_min_m / CELL_M)
        rendered = np.full(grid.cells.shape, UNKNOWN)
        for (column, row), value in expected.items():
            rendered[row - low, column - left] = value
        np.testing.assert_array_equal(grid.cells, rendered)
        columns, rows = zip(*expected, strict=True)
        assert grid.cells.shape == (max(rows) - min(rows) + 1, max(columns) - min(columns) + 1)
        assert grid.version == max(t.version for t in store.since(0) if t.level == 0)


def test_a_grid_given_out_never_changes():
    store = TileStore()
    store.update([tile(0, 0, 1, value=0)])
    first = store.grid()
    store.update([tile(0, 0, 2, value=100)])
    second = store.grid()
    assert (first.cells == 0).all()
    assert (second.cells == 100).all()
    with pytest.raises(ValueError, match="read-only"):
        second.cells[0, 0] = 1


def test_a_tile_far_away_is_refused_as_a_picture_and_kept_as_a_tile():
    store = TileStore()
    store.update([tile(0, 0, 1), tile(10_000, 10_000, 2)])
    for _ in range(2):
        with pytest.raises(StorageError, match=r"spans 40004 x 40004 m, 6401280064 cells"):
            store.grid()
    assert len(store.since(0)) == 2


def test_updates_and_pictures_from_two_threads_end_in_the_same_map():
    store = TileStore()

    def render(ended: threading.Event) -> None:
        while not ended.is_set():
            store.grid()

    with in_background(render):
        for version in range(1, 400):
            store.update([tile(version % 11 - 5, version % 7 - 3, version, value=version % 101)])
    grid = store.grid()
    for t in store.since(0):
        row, column = (t.iy + 3) * EDGE, (t.ix + 5) * EDGE
        assert (grid.cells[row : row + EDGE, column : column + EDGE] == t.cells[0, 0]).all()


def test_an_emptied_map_is_unknown_tiles_with_new_versions_for_those_who_hold_the_old():
    store = TileStore()
    store.update([tile(0, 0, 5), tile(3, -2, 6), tile(0, 0, 2, level=1)])
    emptied = store.start_over()
    assert [(t.level, t.ix, t.iy, t.version) for t in emptied] == [(1, 0, 0, 7), (0, 0, 0, 8), (0, 3, -2, 9)]
    assert all((t.cells == UNKNOWN).all() and not t.cells.flags.writeable for t in emptied)
    assert [t.version for t in store.since(0)] == [7, 8, 9]
    assert store.version == 9
    store.update([tile(0, 0, 10, value=100)])
    assert [(t.ix, t.version) for t in store.since(8)] == [(3, 9), (0, 10)]


def test_the_picture_of_an_emptied_map_is_one_unknown_tile_and_the_next_map_does_not_span_the_old():
    store = TileStore()
    store.update([tile(k, 5, k + 1, value=100) for k in range(9)])
    assert store.grid() is not None
    store.start_over()
    blank = store.grid()
    assert (blank.version, blank.x_min_m, blank.y_min_m, blank.cells.shape) == (18, 0.0, 0.0, (EDGE, EDGE))
    assert (blank.cells == UNKNOWN).all()
    store.update([tile(-1, 0, 19, value=100)])
    grid = store.grid()
    assert (grid.version, grid.x_min_m, grid.cells.shape) == (19, -EDGE * CELL_M, (EDGE, 2 * EDGE))
    assert np.count_nonzero(grid.cells == 100) == EDGE * EDGE


def test_maps_are_handed_out_whole_one_after_another():
    store = TileStore()
    assert store.start_over() == []
    assert store.number == 1
    store.update([tile(0, 0, 1, value=100), tile(1, 0, 2, value=100)])
    store.start_over()
    store.start_over()  # nothing to empty
    store.update([tile(0, 0, 5, value=50)])
    assert store.number == 2
    ended, present = store.take()
    assert [(m.number, m.version, [t.version for t in m.tiles]) for m in ended] == [(1, 2, [1, 2])]
    assert all((t.cells == 100).all() for t in ended[0].tiles)
    assert (present.number, present.version, len(present.tiles)) == (2, 5, 1)
    assert store.take()[0] == []


def test_a_map_keeps_its_place_on_the_earth_when_another_begins():
    store = TileStore()
    store.update([tile(0, 0, 1)])
    store.place(GEO)
    store.start_over()
    store.update([tile(0, 0, 5)])
    (ended,), present = store.take()
    assert ended.geo == GEO
    assert present.geo is None
