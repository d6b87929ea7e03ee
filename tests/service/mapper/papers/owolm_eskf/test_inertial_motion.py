import math

import numpy as np
import pytest

from drivers.frames import ImuSample
from service.geometry.se2 import SE2
from service.mapper.papers.owolm_eskf.inertial_motion import InertialMotion, InertialMotionConfig
from tests.service.estimator.samples import MS, matched, odometry

SURE = np.diag([1e-5, 1e-5, 1e-6])
NOTHING = (0.0, 0.0, 0.0)


def imu(stamp_ms, rate=NOTHING, force=(0.0, 0.0, 9.81)) -> ImuSample:
    return ImuSample("imu", round(stamp_ms * MS), round(stamp_ms * MS), rate, force)


def driven(model: InertialMotion, from_ms: int, to_ms: int, speed_mps: float, with_imu: bool = True) -> None:
    """Straight on at a constant speed, a match every 25 ms."""
    for stamp_ms in range(from_ms, to_ms, 5):
        if with_imu:
            model.add(imu(stamp_ms))
        if stamp_ms % 25 == 0:
            model.predict(stamp_ms * MS)
            model.correct(matched(SE2(speed_mps * stamp_ms * 1e-3, 0.0, 0.0), SURE))


def test_the_imu_carries_the_pose_between_scans():  # B6 B13
    model = InertialMotion(InertialMotionConfig())
    driven(model, 0, 1000, 1.0)
    for stamp_ms in range(1000, 1201, 5):  # 0.2 s of braking at 2 m/s^2 and turning at 1 rad/s, no scan
        model.add(imu(stamp_ms, (0.0, 0.0, 1.0), (-2.0, 1.0, 9.81)))
    predicted = model.predict(1200 * MS)
    assert predicted.pose_odom_base.x_m == pytest.approx(1.0 + 0.2 - 0.5 * 2.0 * 0.04, abs=0.01)
    assert predicted.pose_odom_base.theta_rad == pytest.approx(0.2, abs=0.005)
    assert predicted.twist_base[0] == pytest.approx(0.6, abs=0.05)
    assert predicted.twist_base[2] == pytest.approx(1.0, abs=0.02)
    assert predicted.covariance[0, 0] > 0.0
    assert predicted.is_measured


def test_samples_out_of_order_are_put_in_place_as_long_as_their_time_has_not_passed():  # B13
    stamps = list(range(0, 100, 5))
    samples = {ms: imu(ms, (0.0, 0.0, 0.01 * ms), (0.1, 0.0, 9.81)) for ms in stamps}
    poses = []
    for order in (stamps, [*stamps[2:8], *stamps[:2], *reversed(stamps[8:])]):
        model = InertialMotion(InertialMotionConfig())
        model.predict(0)
        assert all(model.add(samples[ms]) for ms in order if ms > 0)
        assert not model.add(samples[40])  # twice
        assert not model.add(samples[0])  # at a time that has been used up
        poses.append(model.predict(95 * MS).pose_odom_base)
    assert poses[0] == poses[1]
    assert poses[0].theta_rad > 0.01


def test_standing_before_the_first_scan_gives_tilt_and_biases():  # B3
    """1 s on a floor that slopes by 2 deg and rolls by 1, with a gyro that is off."""
    noise = np.random.default_rng(1)
    model = InertialMotion(InertialMotionConfig(rate_density_radps=0.0002))
    pitch, roll = math.radians(-2.0), math.radians(1.0)
    gravity = 9.81 * np.array(
        [-math.sin(pitch), math.cos(pitch) * math.sin(roll), math.cos(pitch) * math.cos(roll)]
    )
    rates = [0.0, 0.0, 0.002] + 0.003 * noise.standard_normal((200, 3))
    for stamp_ms, rate in zip(range(0, 1000, 5), rates, strict=True):
        model.add(imu(stamp_ms, tuple(rate), tuple(gravity + 0.02 * noise.standard_normal(3))))
    first = model.predict(1000 * MS)
    assert first.pose_odom_base == SE2()
    assert first.twist_base[:2] == pytest.approx((0.0, 0.0), abs=0.01)
    rotation = model.filters.across.rotation
    assert math.asin(-rotation[2, 0]) == pytest.approx(pitch, abs=0.003)
    assert math.atan2(rotation[2, 1], rotation[2, 2]) == pytest.approx(roll, abs=0.003)
    assert model.filters.across.rate_bias[2] == pytest.approx(rates[:, 2].mean(), abs=0.0002)


@pytest.mark.parametrize("wheels", [True, False])
def test_without_an_imu_wheels_or_the_last_speed_go_on(wheels):
    model = InertialMotion(InertialMotionConfig())
    for stamp_ms in range(0, 2000, 25):
        if wheels:
            model.add(odometry(stamp_ms, SE2(0.001 * stamp_ms, 0.0, 0.0)))
    driven(model, 0, 1000, 1.0, with_imu=False)
    predicted = model.predict(1200 * MS)
    assert predicted.is_measured == wheels
    assert predicted.pose_odom_base.x_m == pytest.approx(1.2, abs=0.03)
    assert predicted.twist_base[0] == pytest.approx(1.0, abs=0.1)
    assert math.sqrt(predicted.covariance[0, 0]) > 0.02


def test_wheels_beside_an_imu_hold_the_speed_where_scans_say_nothing():
    reached = []
    for wheels in (True, False):
        model = InertialMotion(InertialMotionConfig())
        for stamp_ms in range(0, 4000, 5):
            model.add(imu(stamp_ms, force=(0.05, 0.0, 9.81)))  # an accelerometer that is off
            if wheels:
                model.add(odometry(stamp_ms, SE2()))
        model.predict(0)
        for stamp_ms in range(25, 4000, 25):
            predicted = model.predict(stamp_ms * MS)
            model.correct(None)
        reached.append(abs(predicted.pose_odom_base.x_m))
    assert reached[0] < 0.1
    assert reached[1] > 0.3


def test_an_imu_mounted_sideways_is_turned_into_the_base():  # B9
    model = InertialMotion(InertialMotionConfig(imu_yaw_rad=math.pi / 2))  # its x looks left
    driven(model, 0, 500, 0.0)
    for stamp_ms in range(500, 701, 5):
        model.add(imu(stamp_ms, force=(0.0, -1.0, 9.81)))  # ahead is to its right
    predicted = model.predict(700 * MS)
    assert predicted.twist_base[0] == pytest.approx(0.2, abs=0.03)
    assert abs(predicted.twist_base[1]) < 0.03
