"""Tiles for tests, and where their map lies."""

import numpy as np

from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.outputs import TileUpdate

EDGE, CELL_M = 8, 0.5
GEO = GeoReference(LocalFrame(60.161, 24.546, 51.7), SE2(3.0, -4.0, 0.0), 0.8, 0.01, 41)


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
