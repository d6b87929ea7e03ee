"""Tiles for tests."""

import numpy as np

from service.outputs import TileUpdate

EDGE, CELL_M = 8, 0.5


def tile(
    ix: int, iy: int, version: int, value: int | None = None, level: int = 0, edge: int = EDGE
) -> TileUpdate:
    """A tile full of `value`, or of seeded random occupancy where it is None."""
    if value is not None:
        cells = np.full((edge, edge), value, dtype=np.int8)
    else:
        random = np.random.default_rng([version, abs(ix), abs(iy), ix < 0, iy < 0])
        cells = random.integers(-1, 101, size=(edge, edge), dtype=np.int8)
    cells.setflags(write=False)
    return TileUpdate(level, ix, iy, version, CELL_M, cells)


def same(a: TileUpdate, b: TileUpdate) -> bool:
    keys = [(t.level, t.ix, t.iy, t.version, t.cell_m) for t in (a, b)]
    return keys[0] == keys[1] and np.array_equal(a.cells, b.cells)
