import pickle

import numpy as np
import pytest

from service.mapper.papers.submap_graph.key_scan import BEARING_STEP_RAD, RANGE_STEP_M, KeptScan, KeyScan

STEP_RAD = np.radians(0.5)


def scan_of(range_m: np.ndarray, bearing_rad: np.ndarray, sensor_xy_m: tuple[float, float]) -> KeyScan:
    xy = range_m[:, None] * np.stack((np.cos(bearing_rad), np.sin(bearing_rad)), axis=1) + sensor_xy_m
    return KeyScan(7, xy.astype(np.float32), sensor_xy_m, STEP_RAD)


# D8
@pytest.mark.parametrize("reach_m", [1.0, 20.0, 100.0])
def test_end_points_come_back_to_half_a_step_of_range_and_bearing(reach_m: float) -> None:
    rng = np.random.default_rng(1)
    bearing = np.cumsum(rng.uniform(-0.1, 0.3, 300))  # over the border of a turn, and back and forth
    scan = scan_of(rng.uniform(0.01, reach_m, 300), bearing, (0.3, -2.0))
    kept = pickle.loads(pickle.dumps(KeptScan.of(scan)))
    assert (kept.stamp_ns, kept.sensor_xy_m, kept.angle_step_rad) == (7, (0.3, -2.0), STEP_RAD)
    assert kept.xy_base.dtype == np.float32
    away, before = (one.xy_base.astype(np.float64) - one.sensor_xy_m for one in (kept, scan))
    range_m = np.hypot(*before.T)
    float32_m = 1e-6 + 1e-7 * reach_m
    assert np.abs(np.hypot(*away.T) - range_m).max() < 0.5 * RANGE_STEP_M + float32_m
    across_m = np.abs(before[:, 0] * away[:, 1] - before[:, 1] * away[:, 0]) / range_m
    assert (across_m < 0.5 * BEARING_STEP_RAD * range_m + float32_m).all()
    assert across_m.max() > 0.4 * BEARING_STEP_RAD * 0.5 * reach_m  # it is kept in steps indeed
