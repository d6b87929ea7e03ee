"""What a page shows of a map that is given to it complete at each update."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from service.mapstore.tiles import TileKey, TileStore
from service.outputs import UNKNOWN, TileUpdate


class ShownTiles:
    """Hands on to a store what differs from what it has; one thread."""

    def __init__(self, store: TileStore) -> None:
        self._store = store
        self._shown: dict[TileKey, TileUpdate] = {}

    def take(self, tiles: Sequence[TileUpdate]) -> None:
        """All tiles of the map as it is now; one that is not there any more becomes unknown."""
        present = {(tile.level, tile.ix, tile.iy): tile for tile in tiles}
        changed = [tile for key, tile in present.items() if not _is_same(self._shown.get(key), tile)]
        changed += [
            replace(tile, cells=np.full_like(tile.cells, UNKNOWN))
            for key, tile in self._shown.items()
            if key not in present
        ]
        first = self._store.version + 1
        self._store.update(replace(tile, version=version) for version, tile in enumerate(changed, first))
        self._shown = present


def _is_same(shown: TileUpdate | None, tile: TileUpdate) -> bool:
    return shown is not None and np.array_equal(shown.cells, tile.cells)
