"""Tiles for tests, and where their map lies; graphs, behind which no drive stands."""

import numpy as np

from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.mapper.saved_graph import SavedGraph
from service.outputs import TileUpdate

EDGE, CELL_M = 8, 0.5
GEO = GeoReference(LocalFrame(60.161, 24.546, 51.7), SE2(3.0, -4.0, 0.0), 0.8, 0.01, 41)
POINTS = 3  # of each key frame


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


def graph_of(count: int) -> SavedGraph:
    """Key frames with seeded random poses and points, and one loop. A longer one begins with the same."""
    return SavedGraph(
        stamp_ns=np.arange(count, dtype=np.int64),
        odom=_random(count, 1, 3),
        map=_random(count, 2, 3),
        path_length_m=0.3 * np.arange(count),
        covariance=np.tile(np.eye(3), (count, 1, 1)),
        score=np.ones(count),
        gap_s=np.full(count, np.inf),
        segment=np.zeros(count, np.int64),
        is_lost=np.zeros(count, np.bool_),
        range_sigma_m=np.full(count, 0.012),
        sensor_xy_m=np.zeros((count, 2)),
        point_count=np.full(count, POINTS),
        xy_base=np.round(_random(POINTS * count, 3, 2), 3).astype(np.float32),
        normals=np.round(_random(POINTS * count, 4, 3), 4).astype(np.float32),
        loop_ends=np.array([[0, count - 1]]),
        loop_measured=np.full((1, 3), float(count)),
        loop_covariance=np.eye(3)[None],
        loop_score=np.ones(1),
        loop_points=np.full(1, 400),
        loop_against=np.zeros(1),
    )


def _random(count: int, seed: int, width: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, width))
