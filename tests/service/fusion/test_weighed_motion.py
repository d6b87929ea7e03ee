import math

import numpy as np
import pytest

from service.fusion.drift import match_covariance
from service.fusion.motion import Matched, Motion, Prediction
from service.fusion.weighed_motion import MotionConfig, WeighedMotion
from service.geometry.se2 import SE2
from tests.service.fusion.samples import MS, gyro, matched, odometry

SURE = np.diag([1e-6, 1e-6, 1e-8])


def sigmas(predicted: Prediction) -> np.ndarray:
    return np.sqrt(np.diag(predicted.step_covariance))


def test_the_odom_frame_is_the_base_at_the_first_scan() -> None:
    model = WeighedMotion(MotionConfig())
    model.add(odometry(0, SE2(70.0, 8.0, 1.0)))
    model.add(odometry(20, SE2(70.02, 8.0, 1.0)))
    predicted = model.predict(20 * MS)
    assert predicted.pose_odom_base == SE2()
    assert predicted.elapsed_s == 0.0
    forward, left, turn = predicted.twist_base
    assert (forward, left, turn) == pytest.approx((math.cos(1.0), -math.sin(1.0), 0.0))


def test_wheels_carry_the_pose_from_match_to_scan() -> None:
    model = WeighedMotion(MotionConfig())
    for stamp_ms in range(0, 201, 20):
        model.add(odometry(stamp_ms, SE2(70.0, 8.0, 1.0) @ SE2(stamp_ms / 1e3, 0.0, 0.0)))
    model.correct(50 * MS, matched(SE2(1.0, 2.0, math.pi / 2.0)))
    predicted = model.predict(150 * MS)
    assert predicted.pose_odom_base.x_m == pytest.approx(1.0)
    assert predicted.pose_odom_base.y_m == pytest.approx(2.1)
    assert predicted.twist_base == pytest.approx((1.0, 0.0, 0.0), abs=1e-12)
    assert predicted.elapsed_s == pytest.approx(0.1)
    assert sigmas(predicted) == pytest.approx([0.02 + 0.01, 0.02 + 0.01, 0.02 + 0.002])


def test_a_guess_beyond_the_samples_is_trusted_less() -> None:
    model = WeighedMotion(MotionConfig())
    for stamp_ms in range(0, 201, 20):
        model.add(odometry(stamp_ms, SE2(stamp_ms / 1e3, 0.0, 0.0)))
    model.correct(100 * MS, matched(SE2()))
    assert sigmas(model.predict(200 * MS))[0] == pytest.approx(0.03)
    guessed = model.predict(500 * MS)
    assert guessed.pose_odom_base.x_m == pytest.approx(0.4)
    assert sigmas(guessed)[0] == pytest.approx(0.02 + 0.04 + 0.5 * 2.0 * 0.3**2)


def test_without_odometry_the_last_speed_goes_on() -> None:
    model = WeighedMotion(MotionConfig())
    model.correct(0, matched(SE2()))
    assert model.predict(100 * MS).pose_odom_base == SE2()
    assert sigmas(model.predict(100 * MS))[0] == pytest.approx(0.02 + 0.1)  # it may be moving already
    model.correct(100 * MS, matched(SE2(0.1, 0.0, 0.0), (1.0, 0.0, 0.2)))
    predicted = model.predict(200 * MS)
    expected = SE2(0.1, 0.0, 0.0) @ SE2.exp(0.1, 0.0, 0.02)
    assert predicted.pose_odom_base == expected
    assert sigmas(predicted)[0] == pytest.approx(0.02 + 2.0 * 0.1**2)


def test_the_gyro_turns_and_the_wheels_drive() -> None:
    model = WeighedMotion(MotionConfig())
    for stamp_ms in range(0, 201, 20):
        model.add(odometry(stamp_ms, SE2(stamp_ms / 1e3, 0.0, 0.0)))
        model.add(gyro(stamp_ms, 0.5))
    model.correct(0, matched(SE2()))
    predicted = model.predict(200 * MS)
    assert predicted.pose_odom_base.theta_rad == pytest.approx(0.1)
    arc = SE2.exp(0.2, 0.0, 0.1)
    assert predicted.pose_odom_base.x_m == pytest.approx(arc.x_m)
    assert predicted.pose_odom_base.y_m == pytest.approx(arc.y_m)
    assert predicted.twist_base == pytest.approx((1.0, 0.0, 0.5))
    assert sigmas(predicted)[2] == pytest.approx(0.005 + 0.02 * 0.1)


def test_wheels_that_stand_still_are_believed_and_wheels_that_turn_less() -> None:
    config = MotionConfig()
    for step_m, expected in ((0.0, config.standing_sigma_m), (0.01, config.position_sigma_m + 0.001)):
        model = WeighedMotion(config)
        for k in range(10):
            model.add(odometry(10 * k, SE2(k * step_m / 2.0, 0.0, 0.0)))
        model.predict(0)
        model.correct(0, matched(SE2()))
        assert sigmas(model.predict(20 * MS))[0] == pytest.approx(expected)


def test_late_samples_are_refused() -> None:
    model = WeighedMotion(MotionConfig())
    assert model.add(odometry(20, SE2()))
    assert not model.add(odometry(10, SE2()))
    assert model.add(gyro(20, 0.0))
    assert not model.add(gyro(20, 0.0))


def test_a_short_scan_interval_teaches_the_twist_little() -> None:
    model = WeighedMotion(MotionConfig())
    model.correct(0, matched(SE2()))
    assert model.predict(20 * MS).twist_gain == pytest.approx(1.0 - math.exp(-2.0 / 3.0))
    assert model.predict(500 * MS).twist_gain > 0.99


def test_uncertainty_is_carried_along_and_grows_with_the_way() -> None:
    model = WeighedMotion(MotionConfig())
    model.add(odometry(0, SE2()))
    model.add(odometry(1000, SE2(10.0, 0.0, 0.0)))
    known = np.diag([1e-4, 1e-4, 1e-4])
    model.correct(0, Matched(SE2(), (10.0, 0.0, 0.0), known, np.linalg.inv(known)))
    covariance = model.predict(1000 * MS).covariance
    assert covariance[0, 0] == pytest.approx(1e-4 + 0.02**2 * 10.0 + 0.005**2)
    assert covariance[1, 1] == pytest.approx(covariance[0, 0] + 1e-4 * 10.0**2)  # 0.01 rad over 10 m
    assert covariance[1, 2] == pytest.approx(1e-4 * 10.0)
    assert covariance[2, 2] > 1e-4


def test_only_differences_of_time_count() -> None:
    def run(offset_ns: int) -> Prediction:
        model = WeighedMotion(MotionConfig())
        model.correct(offset_ns, matched(SE2()))
        model.correct(offset_ns + 100 * MS, matched(SE2(0.1, 0.0, 0.01), (1.0, 0.0, 0.1)))
        return model.predict(offset_ns + 133 * MS)

    near, unix = run(5), run(1_700_000_000_000_000_005)
    assert near.pose_odom_base == unix.pose_odom_base
    np.testing.assert_array_equal(near.covariance, unix.covariance)


def driven(metres: int, information: np.ndarray, wheel_scale: float = 1.0) -> tuple[WeighedMotion, Motion]:
    """A metre a second ahead, matched where it is at each metre with that much information."""
    model = WeighedMotion(MotionConfig())
    for stamp_ms in range(0, 1000 * metres + 1, 100):
        model.add(odometry(stamp_ms, SE2(wheel_scale * stamp_ms / 1e3, 0.0, 0.0)))
    believed = Motion(SE2(), (0.0, 0.0, 0.0), SURE)
    for k in range(metres + 1):
        model.predict(1000 * k * MS)
        believed = model.correct(
            1000 * k * MS, Matched(SE2(float(k), 0.0, 0.0), (1.0, 0.0, 0.0), SURE, information)
        )
    return model, believed


def test_drift_of_the_map_is_in_what_is_believed() -> None:
    sharp = np.diag([1e6, 1e6, 1e7])  # a millimetre
    near, far = (driven(metres, sharp)[1].covariance for metres in (4, 64))
    assert math.sqrt(near[0, 0]) < 0.002
    assert math.sqrt(far[0, 0]) == pytest.approx(math.sqrt(64 * 0.07e-6), rel=0.15)
    assert far[1, 1] > far[0, 0]  # the heading's drift moves it sideways
    blunt = driven(64, sharp / 100.0)[1].covariance
    assert math.sqrt(blunt[0, 0]) == pytest.approx(10.0 * math.sqrt(far[0, 0]), rel=0.1)


def test_standing_adds_no_drift() -> None:
    model, moved = driven(16, np.diag([1e6, 1e6, 1e7]))
    for k in range(17, 60):
        model.predict(1000 * k * MS)
        stands = Matched(SE2(16.0, 0.0, 0.0), (0.0, 0.0, 0.0), SURE, np.diag([1e6, 1e6, 1e7]))
        believed = model.correct(1000 * k * MS, stands)
    np.testing.assert_allclose(np.diag(believed.covariance), np.diag(moved.covariance), rtol=0.05)


def test_the_scale_of_the_wheels_adds_up_along_a_blind_way() -> None:
    blind = np.diag([0.0, 1e6, 1e7])  # says nothing of the way ahead
    short, long = (math.sqrt(driven(metres, blind)[1].covariance[0, 0]) for metres in (25, 100))
    assert long > 1.0  # 1 % of it
    assert long > 3.3 * short  # a random walk would double it


@pytest.mark.parametrize("scale", [0.8, 1.2])
def test_wheels_that_roll_too_far_are_seen_through(scale: float) -> None:
    model, _ = driven(40, np.diag([1e6, 1e6, 1e7]), scale)
    before = model.predict(40_000 * MS).pose_odom_base
    assert before.x_m == pytest.approx(40.0, abs=1e-6)
    model.add(odometry(41_000, SE2(scale * 41.0, 0.0, 0.0)))
    assert model.predict(41_000 * MS).pose_odom_base.x_m == pytest.approx(41.0, abs=0.01)


def test_a_blind_way_teaches_nothing_of_the_wheels() -> None:
    model, _ = driven(40, np.diag([0.0, 1e6, 1e7]), 1.2)
    model.add(odometry(41_000, SE2(1.2 * 41.0, 0.0, 0.0)))
    assert model.predict(41_000 * MS).pose_odom_base.x_m == pytest.approx(41.2, abs=1e-6)


def test_a_graph_is_told_the_match_alone() -> None:
    _, believed = driven(64, np.diag([1e6, 1e6, 1e7]))
    assert match_covariance(believed)[0, 0] == pytest.approx(1e-6, rel=1e-3)
    assert believed.covariance[0, 0] > 4e-6
    unmatched = Motion(SE2(), (0.0, 0.0, 0.0), SURE)
    assert match_covariance(unmatched) is SURE


@pytest.mark.parametrize("on_new_map", [False, True])
def test_what_was_lost_stays_lost_on_a_new_map_only(on_new_map: bool) -> None:
    model, before = driven(4, np.diag([1e6, 1e6, 1e7]))
    for k in (5, 6, 7):
        model.add(odometry(1000 * k, SE2(float(k), 0.0, 0.0)))
        predicted = model.predict(1000 * k * MS)
        lost = model.correct(1000 * k * MS, predicted)
    assert math.sqrt(lost.covariance[0, 0]) > 0.03
    model.add(odometry(8000, SE2(8.0, 0.0, 0.0)))
    model.predict(8000 * MS)
    found = Matched(SE2(8.001, 0.0, 0.0), (1.0, 0.0, 0.0), SURE, np.diag([1e6, 1e6, 1e7]), on_new_map)
    sigma_m = math.sqrt(model.correct(8000 * MS, found).covariance[0, 0])
    assert (sigma_m > 0.03) == on_new_map
    assert sigma_m > math.sqrt(before.covariance[0, 0])


def test_wheels_that_are_left_out_teach_nothing() -> None:
    """Backwards at 1 m/s, 20 scans a second."""
    model = WeighedMotion(MotionConfig())
    knows = np.diag([1e6, 1e6, 1e7])
    off_m = []
    for k in range(200):
        model.add(odometry(50 * k, SE2(-0.05 * k, 0.0, 0.0)))
        off_m.append(model.predict(50 * k * MS).pose_odom_base.x_m - 0.05 * k)
        found = Matched(SE2(0.05 * k, 0.0, 0.0), (1.0, 0.0, 0.0), SURE, knows)
        model.correct(50 * k * MS, found)
    assert "the wheels contradict" in model.complaint
    assert np.abs(off_m[50:]).max() < 1e-6  # the last speed goes on
    assert model._trust.scale == pytest.approx(1.0, abs=0.01)


def test_a_slip_teaches_nothing_of_the_size_of_the_wheels() -> None:
    """Wheels that freeze for most of the way, as on a bus that stalls: too far off to be of another size."""
    model = WeighedMotion(MotionConfig())
    knows = np.diag([1e6, 1e6, 1e7])
    for k in range(40):
        model.add(odometry(1000 * k - 500, SE2(0.5 * k - 0.25, 0.0, 0.0)))
        model.add(odometry(1000 * k, SE2(0.5 * k, 0.0, 0.0)))
        model.predict(1000 * k * MS)
        model.correct(1000 * k * MS, Matched(SE2(2.0 * k, 0.0, 0.0), (2.0, 0.0, 0.0), SURE, knows))
    assert model._trust.scale == pytest.approx(1.0, abs=0.01)
