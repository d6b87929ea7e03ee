"""Odometry that says the same pose again and again: while its vehicle stands, and for ever."""

import numpy as np
import pytest

from service.fusion.estimator import Estimator, EstimatorConfig
from service.geometry.se2 import SE2
from tests.service.fusion.samples import MS, SURE, matched, odometry

VAGUE = np.diag([0.015**2, 1e-6, 1e-8])  # along a corridor, m^2
DEAD_MS = 4000


def way_m_at(stamp_ms: int, stands_ms: tuple[int, int]) -> float:
    """1 m/s, but for a stop with 2 m/s^2 before and after."""
    at_s, (from_s, until_s) = stamp_ms * 1e-3, (stands_ms[0] * 1e-3, stands_ms[1] * 1e-3)
    braked_s = min(max(at_s - from_s, 0.0), 0.5)
    begun_s = min(max(at_s - until_s, 0.0), 0.5)
    stood_s = min(max(at_s - from_s - 0.5, 0.0), until_s - from_s - 0.5)
    return at_s - braked_s**2 - stood_s - (begun_s - begun_s**2)


@pytest.mark.parametrize(
    "dies_ms", [0, DEAD_MS, 6500, None], ids=["never lived", "driving", "standing", "lives"]
)
def test_odometry_that_says_the_same_pose_for_ever_is_believed_only_while_the_vehicle_stands(
    dies_ms: int | None,
) -> None:
    """It claims to stand to 0.2 mm, where scans know the way to 15 mm. It stands from 6.5 to 8 s."""
    model, random, stands_ms = Estimator(EstimatorConfig()), np.random.default_rng(5), (6000, 8000)
    off_m, faults, counted_m = [], [], 0.0
    for stamp_ms in range(0, 12_001, 20):
        way_m = way_m_at(stamp_ms, stands_ms)
        if dies_ms is None or stamp_ms <= dies_ms:
            counted_m = way_m
        assert model.add(odometry(stamp_ms, SE2(counted_m, 0.0, 0.0)))
        if stamp_ms % 100 == 0:
            model.predict(stamp_ms * MS)
            seen = SE2(way_m + random.normal(0.0, 0.015), 0.0, 0.0)
            found = model.correct(matched(seen, VAGUE)).pose_odom_base
            off_m.append(abs(found.x_m - way_m))
            faults.append(model.fault)
    # The one that dies unnoticed is found out by what the scans say against it.
    assert max(off_m) < (0.5 if dies_ms == 6500 else 0.08)
    assert faults[-1].startswith("odometry contradicts the scans (it says the same pose again") is (
        dies_ms is not None
    )
    if dies_ms is None:
        assert not any(faults)


def test_odometry_that_moves_again_counts_again() -> None:
    model = Estimator(EstimatorConfig())
    for stamp_ms in range(0, 12_001, 20):
        way_m, hangs = stamp_ms * 1e-3, 4000 <= stamp_ms < 8000
        assert model.add(odometry(stamp_ms, SE2(4.0 if hangs else way_m, 0.0, 0.0)))
        if stamp_ms % 100 == 0:
            predicted = model.predict(stamp_ms * MS)
            model.correct(matched(SE2(way_m, 0.0, 0.0), SURE))
            assert predicted.pose_odom_base.x_m == pytest.approx(way_m, abs=0.05)
            if 5200 <= stamp_ms < 8000:
                assert model.fault
                assert not predicted.is_measured
    assert predicted.is_measured
    assert not model.fault
