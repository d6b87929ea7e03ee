"""Wheels that change their speed faster than a vehicle can."""

import numpy as np
import pytest

from service.estimator.samples import Samples
from service.estimator.wheel_slip import WheelSlip
from tests.accuracy.scene_drives import Case
from tests.accuracy.sensors import LUX_AHEAD, MIRRORS
from tests.service.estimator.samples import MS
from tests.service.mapper.scan_match.test_moving_scene import judged

FIXED, OPEN = np.diag([1e4, 1e4, 1e6]), np.diag([1.0, 1e4, 1e6])  # information of a scan
SCAN_S = 0.1


def driven(
    speeds_mps: np.ndarray, period_ms: float = 15.0, noise_m: float = 0.001, jitter_ms: float = 0.0
) -> WheelSlip:
    """Odometry has this speed in each period."""
    slip, samples, random = WheelSlip(), Samples(5), np.random.default_rng(1)
    x_m = 0.0
    for k, speed_mps in enumerate(speeds_mps):
        x_m += speed_mps * period_ms * 1e-3 + random.normal(0.0, noise_m)
        stamp_ms = k * period_ms + random.uniform(-jitter_ms, jitter_ms)
        samples.append(round(stamp_ms * MS), (x_m, 0.0, 0.0, 0.0, 0.0))
        slip.add(samples.track)
    return slip


def jumping(*speeds_mps: float) -> np.ndarray:
    return np.repeat(speeds_mps, 200)


def test_a_jump_of_speed_is_a_slip() -> None:
    assert driven(jumping(1.0, 1.5)).speed_mps == pytest.approx(0.5, abs=0.15)
    assert driven(jumping(2.0, 1.0)).speed_mps == pytest.approx(-1.0, abs=0.15)


@pytest.mark.parametrize(
    "slip",
    [
        pytest.param(driven(jumping(1.0, 1.5, 1.0)), id="it returns"),
        pytest.param(driven(np.linspace(0.0, 2.0, 50)), id="2.7 m/s^2"),
        pytest.param(driven(jumping(1.0, 3.0), period_ms=150.0), id="odometry at 7 Hz"),
        pytest.param(driven(jumping(1.0, 1.0), noise_m=0.012), id="noise"),
        pytest.param(driven(jumping(1.0, 1.0), jitter_ms=6.0), id="stamps that jitter"),
    ],
)
def test_other_changes_of_speed_are_no_slip(slip: WheelSlip) -> None:
    assert slip.speed_mps == 0.0
    assert slip.step(SCAN_S) is None


def test_sigma_grows_by_the_slip_while_scans_leave_a_direction_open() -> None:
    slip = driven(jumping(1.0, 1.5))
    variance_m2 = 0.0
    for _ in range(20):
        step = slip.step(SCAN_S)
        assert step is not None
        variance_m2 += step[0, 0]
        slip.compare(OPEN, 0.0)
    assert np.sqrt(variance_m2) == pytest.approx(2.0 * slip.speed_mps)


@pytest.mark.parametrize(("slipping_mps", "is_slipping"), [(0.0, False), (0.45, True)])
def test_scans_that_fix_the_position_confirm_or_refute_a_slip(slipping_mps: float, is_slipping: bool) -> None:
    slip = driven(jumping(1.0, 1.5))
    for _ in range(12):
        slip.step(SCAN_S)
        slip.compare(FIXED, slipping_mps * SCAN_S)
    assert bool(slip.speed_mps) is is_slipping


@pytest.mark.parametrize(
    ("case", "worst_m"),
    [
        (Case("wheels_spin", "ring", 800, 0.341, 1.0, laser=LUX_AHEAD), 0.2),  # without: 2.1 m
        (Case("wheels_spin", "ring", 808, 0.068, 1.0, laser=MIRRORS["360 deg, 12 m, 8 Hz"]), 3.0),
    ],
)
def test_a_pose_is_not_ok_where_wheels_have_spun_in_a_bare_corridor(case: Case, worst_m: float) -> None:
    verdict, *_ = judged(case)
    assert verdict.worst_m < worst_m
    assert verdict.ok_off == 0
