import math

import pytest

from service.geometry.se2 import SE2
from service.mapper.papers.owolm_eskf.odometry_track import OdometryTrack
from tests.service.estimator.samples import MS, odometry

TWIST = (1.0, 0.0, 0.5)


def on_circle(time_s: float) -> SE2:
    return SE2(3.0, -2.0, 1.0) @ SE2.exp(*(rate * time_s for rate in TWIST))


def track() -> OdometryTrack:
    return OdometryTrack(max_guess_s=1.0, speed_window_s=0.05)


def circling(until_ms: int, step_ms: int = 20) -> OdometryTrack:
    filled = track()
    for stamp_ms in range(0, until_ms + 1, step_ms):
        assert filled.add(odometry(stamp_ms, on_circle(stamp_ms / 1e3)))
    return filled


def as_tuple(pose: SE2) -> tuple[float, float, float]:
    return pose.x_m, pose.y_m, pose.theta_rad


def test_poses_between_samples_lie_on_the_arc() -> None:
    way = circling(1000).between(133 * MS, 777 * MS)
    assert way is not None
    assert as_tuple(way) == pytest.approx(as_tuple(SE2.exp(0.644, 0.0, 0.322)), abs=1e-9)


def test_too_far_beyond_the_samples_nothing_is_reported() -> None:
    filled = circling(1000)
    assert filled.between(900 * MS, 2001 * MS) is None
    assert filled.between(-1001 * MS, 500 * MS) is None
    assert filled.twist_at(2001 * MS) is None
    assert track().between(0, 1) is None


def test_a_late_sample_is_refused() -> None:
    filled = circling(1000)
    assert not filled.add(odometry(1000, on_circle(1.0)))
    assert not filled.add(odometry(990, on_circle(0.99)))
    assert filled.add(odometry(1010, on_circle(1.01)))


def test_a_sample_that_is_no_number_is_refused() -> None:
    assert not track().add(odometry(0, SE2(math.nan, 0.0, 0.0)))


def test_a_burst_of_stamps_is_no_speed() -> None:
    """20 samples of 0.3 s of driving that came together, stamped 0.1 ms apart."""
    filled = circling(1000)
    for k in range(1, 21):
        assert filled.add(odometry(1300.0 + 0.1 * k, on_circle(1.0 + 0.015 * k)))
    twist = filled.twist_at(1310 * MS)
    assert twist == pytest.approx(TWIST, rel=0.02)
    way = filled.between(1000 * MS, 1302 * MS)
    assert way is not None
    assert as_tuple(way) == pytest.approx(as_tuple(SE2.exp(0.3, 0.0, 0.15)), abs=1e-9)


def test_a_burst_alone_says_nothing_of_a_speed() -> None:
    filled = track()
    for k in range(20):
        filled.add(odometry(0.1 * k, SE2(0.01 * k, 0.0, 0.0)))
    assert filled.twist_at(2 * MS) is None
    way = filled.between(0, 500 * MS)
    assert way is not None
    assert way.x_m == pytest.approx(0.19)


def test_the_motion_since_the_last_scan_is_known_however_long_ago_it_was() -> None:
    filled = track()
    for k in range(20_000):  # 300 s, faster than 4096 samples last
        filled.add(odometry(15.0 * k, SE2(0.001 * k, 0.0, 0.0)))
        if k == 1000:
            filled.use_up(15 * k * MS - 7 * MS)
    way = filled.between(15_000 * MS - 7 * MS, 15 * 19_999 * MS)
    assert way is not None
    assert way.x_m == pytest.approx(18.999 + 0.001 * 7 / 15, abs=1e-9)


@pytest.mark.parametrize("scans", [True, False])
def test_a_day_of_samples_does_not_pile_up(scans: bool) -> None:
    filled = track()
    for k in range(20_000):
        filled.add(odometry(15.0 * k, SE2()))
        if scans:
            filled.use_up(round(15.0 * k * MS))
    assert len(filled._stamps) < 5000
    assert filled.between(15 * 19_900 * MS, 15 * 19_999 * MS) is not None
