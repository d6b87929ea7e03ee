import math

import numpy as np
import pytest

from service.kernels.raycast import NO_HIT, cast_rays, index_segments
from tests.soaked import in_soak

NO_DISCS = np.empty((0, 5))


def grid_over(segments: np.ndarray, cell_m: float = 1.0):
    xy = segments.reshape(-1, 2)
    low = xy.min(axis=0) - 0.01
    columns, rows = np.ceil((xy.max(axis=0) + 0.01 - low) / cell_m).astype(int)
    frame = np.array([low[0], low[1], cell_m])
    return frame, *index_segments(segments, frame, int(rows), int(columns))


def cast(rays, segments, discs=NO_DISCS, range_max_m=1e3, cell_m=1.0):
    rays, segments = np.asarray(rays, dtype=float), np.asarray(segments, dtype=float)
    return cast_rays(
        rays, segments, np.asarray(discs, dtype=float), *grid_over(segments, cell_m), range_max_m
    )


def reference(rays, segments, discs, range_max_m):
    """Each ray against everything: a 2 x 2 system a segment, a quadratic a disc."""
    ranges, hits = [], []
    for x, y, angle, time_s in rays:
        direction = np.array([math.cos(angle), math.sin(angle)])
        best_m, best = range_max_m, NO_HIT
        for k, (x0, y0, x1, y1) in enumerate(segments):
            matrix = np.array([direction, [x0 - x1, y0 - y1]]).T
            if abs(np.linalg.det(matrix)) < 1e-12:
                continue
            along, share = np.linalg.solve(matrix, [x0 - x, y0 - y])
            if along >= 0 and 0 <= share <= 1 and along < best_m:
                best_m, best = along, k
        for k, (cx, cy, vx, vy, radius) in enumerate(discs):
            away = np.array([x - cx - time_s * vx, y - cy - time_s * vy])
            if away @ away <= radius**2:
                best_m, best = 0.0, len(segments) + k
                continue
            roots = np.roots([1.0, 2 * away @ direction, away @ away - radius**2])
            if np.isreal(roots).all() and roots.real.min() > 0 and roots.real.min() < best_m:
                best_m, best = roots.real.min(), len(segments) + k
        ranges.append(best_m if best != NO_HIT else np.inf)
        hits.append(best)
    return np.array(ranges), np.array(hits)


@pytest.mark.parametrize("seed", [1, in_soak(2), in_soak(3)])
def test_cast_agrees_with_trying_everything(seed: int):
    rng = np.random.default_rng(seed)
    start = rng.uniform(-10, 10, (60, 2))
    segments = np.hstack([start, start + rng.normal(0, 2, (60, 2))])
    segments[::5, 2] = segments[::5, 0]  # upright ones
    segments[1::5, 3] = segments[1::5, 1]  # flat ones
    discs = np.hstack([rng.uniform(-10, 10, (5, 2)), rng.normal(0, 1, (5, 2)), rng.uniform(0.1, 0.5, (5, 1))])
    rays = np.column_stack([rng.uniform(-14, 14, (200, 2)), rng.uniform(-4, 4, 200), rng.uniform(0, 2, 200)])
    expected_m, expected_hit = reference(rays, segments, discs, 15.0)
    assert np.isfinite(expected_m).sum() > 100
    for cell_m in (0.3, 1.0, 50.0):
        range_m, hit = cast(rays, segments, discs, 15.0, cell_m)
        np.testing.assert_array_equal(hit, expected_hit)
        np.testing.assert_allclose(range_m, expected_m, atol=1e-9)


def test_axis_parallel_rays_hit_walls_on_cell_borders():
    box = [[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]]
    rays = [[1, 1, k * math.pi / 2, 0] for k in range(4)]
    frame = np.array([-1.0, -1.0, 1.0])
    segments = np.array(box, dtype=float)
    range_m, hit = cast_rays(
        np.array(rays), segments, NO_DISCS, frame, *index_segments(segments, frame, 5, 6), 9.0
    )
    np.testing.assert_allclose(range_m, [3, 2, 1, 1], atol=1e-12)
    np.testing.assert_array_equal(hit, [1, 2, 3, 0])
