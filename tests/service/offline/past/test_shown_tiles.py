"""A map given whole, again and again, reaches its store as what differs."""

import numpy as np

from service.mapstore.tiles import TileStore
from service.offline.past.past_page import ShownTiles
from service.outputs import UNKNOWN
from tests.service.mapstore.tile_makers import tile


def test_only_what_differs_gets_a_new_version_and_what_is_gone_becomes_unknown():
    store = TileStore()
    shown, first, second = ShownTiles(store), tile(0, 0, 7, value=3), tile(1, 0, 9, value=4)
    shown.take([first, second])
    assert [t.version for t in store.since(0)] == [1, 2]
    coarse = tile(1, 0, 1, value=5, level=1)
    shown.take([tile(0, 0, 1, value=3), tile(1, 0, 1, value=90), coarse])
    assert [(t.ix, t.level, t.version, int(t.cells[0, 0])) for t in store.since(2)] == [
        (1, 0, 3, 90),
        (1, 1, 4, 5),
    ]
    shown.take([tile(1, 0, 2, value=90), coarse])
    (gone,) = store.since(4)
    assert gone.ix == 0
    assert (gone.cells == UNKNOWN).all()
    shown.take([first, tile(1, 0, 2, value=90), coarse])
    (back,) = store.since(5)
    np.testing.assert_array_equal(back.cells, first.cells)
