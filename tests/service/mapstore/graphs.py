"""Graphs for tests of the store: no drive stands behind them."""

import numpy as np

from service.mapper.saved_graph import SavedGraph

POINTS = 3  # of each key frame


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
