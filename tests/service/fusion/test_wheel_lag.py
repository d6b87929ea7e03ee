"""Wheels whose stamps are late against the scans."""

import math

import numpy as np
import pytest

from drivers.frames import OdometrySample
from service.fusion.weighed_motion import MotionConfig, WeighedMotion
from service.fusion.wheel_lag import WheelLag
from service.fusion.wheel_odometry import OdometryTrack
from service.geometry.se2 import SE2
from tests.service.fusion.samples import MS, matched, odometry

JITTER_S = 0.05


def heading_rad(t_s: float) -> float:
    """Turns to and fro, the rate changing all the time."""
    return 0.8 * math.sin(1.3 * t_s)


def wheels(lag_s: float, scale: float = 1.0) -> list[OdometrySample]:
    """A minute at 20 Hz."""
    return [odometry(50 * k, SE2(0.0, 0.0, heading_rad(0.05 * k - lag_s) / scale)) for k in range(1200)]


def learnt(samples: list[OdometrySample], scale: float = 1.0, noise_rad: float = 0.0) -> WheelLag:
    """After scans at 10 Hz, each matched where the vehicle truly was, samples coming in as time goes on."""
    track = OdometryTrack(20.0, 20.0, 1.0, 0.05)
    lag = WheelLag(0.1, JITTER_S, 0.5)
    noise = np.random.default_rng(1)
    waiting = list(samples)
    last_ns, last_rad = 0, heading_rad(0.0)
    for k in range(1, 590):
        now_ns = 100 * k * MS
        while waiting and waiting[0].stamp_ns <= now_ns:
            track.add(waiting.pop(0))
        now_rad = heading_rad(0.1 * k) + noise_rad * noise.standard_normal()
        lag.learn(last_ns, now_ns, now_rad - last_rad, max(noise_rad, 1e-4), track, scale)
        last_ns, last_rad = now_ns, now_rad
    return lag


@pytest.mark.parametrize("lag_s", [-0.15, -0.02, 0.0, 0.05, 0.2])
def test_a_lag_is_learnt_from_turns(lag_s: float) -> None:
    assert learnt(wheels(lag_s), noise_rad=0.002).lag_s == pytest.approx(lag_s, abs=0.01)


def test_wheels_of_another_size_have_the_same_lag() -> None:
    assert learnt(wheels(0.1, scale=1.2), scale=1.2).lag_s == pytest.approx(0.1, abs=0.01)


def test_nothing_is_learnt_while_the_rate_stays_the_same() -> None:
    steady = [odometry(50 * k, SE2(0.0, 0.0, 0.01 * k)) for k in range(400)]
    track, lag = OdometryTrack(20.0, 20.0, 1.0, 0.05), WheelLag(0.1, JITTER_S, 0.5)
    for sample in steady:
        track.add(sample)
    for k in range(1, 100):
        lag.learn((k - 1) * 100 * MS, k * 100 * MS, 0.03, 0.001, track, 1.0)  # 0.01 more than the wheels
    assert lag.lag_s == pytest.approx(0.0, abs=1e-9)
    assert lag.sigma_s == pytest.approx(math.hypot(0.1, JITTER_S))


def test_a_lag_beyond_the_longest_is_held_there() -> None:
    track, lag = OdometryTrack(20.0, 20.0, 1.0, 0.05), WheelLag(1.0, JITTER_S, 0.1)
    for sample in wheels(0.3):
        track.add(sample)
    for k in range(1, 200):
        now_ns = 100 * k * MS
        lag.learn(
            now_ns - 100 * MS, now_ns, heading_rad(0.1 * k) - heading_rad(0.1 * k - 0.1), 1e-4, track, 1.0
        )
    assert lag.lag_s == 0.1


def test_scans_in_quick_succession_are_joined() -> None:
    """At 50 Hz a step says next to nothing, five of them say as much as one at 10 Hz."""
    track, lag = OdometryTrack(20.0, 20.0, 1.0, 0.05), WheelLag(0.1, JITTER_S, 0.5)
    for sample in wheels(0.1):
        track.add(sample)
    for k in range(1, 2900):
        now_ns = 20 * k * MS
        turn_rad = heading_rad(0.02 * k) - heading_rad(0.02 * k - 0.02)
        lag.learn(now_ns - 20 * MS, now_ns, turn_rad, 1e-4, track, 1.0)
    assert lag.lag_s == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize(("lag_s", "better"), [(-0.15, 100.0), (0.05, 1.9), (0.15, 1.1)])
def test_a_prediction_asks_the_wheels_at_their_own_time(lag_s: float, better: float) -> None:
    """Late wheels help less: what they have not yet told is a guess."""

    def spread_rad(config: MotionConfig) -> float:
        model, samples, errors_rad = WeighedMotion(config), wheels(lag_s), []
        for k in range(590):
            now_ns = 100 * k * MS
            while samples and samples[0].stamp_ns <= now_ns:
                model.add(samples.pop(0))
            errors_rad.append(model.predict(now_ns).pose_odom_base.theta_rad - heading_rad(0.1 * k))
            model.correct(now_ns, matched(SE2(0.0, 0.0, heading_rad(0.1 * k))))
        return float(np.std(errors_rad[-200:]))

    assert spread_rad(MotionConfig()) < spread_rad(MotionConfig(wheel_lag_sigma_s=0.0)) / better


def test_where_the_speed_changes_the_wheels_are_trusted_less() -> None:
    steady, braking = WeighedMotion(MotionConfig()), WeighedMotion(MotionConfig())
    for k in range(21):
        steady.add(odometry(20 * k, SE2(0.02 * k, 0.0, 0.0)))
        braking.add(odometry(20 * k, SE2(0.02 * min(k, 15), 0.0, 0.0)))
    sigmas = []
    for model in (steady, braking):
        for stamp_ms in (100, 200):
            model.predict(stamp_ms * MS)
            model.correct(stamp_ms * MS, matched(SE2(stamp_ms / 1e3, 0.0, 0.0)))
        sigmas.append(math.sqrt(model.predict(400 * MS).step_covariance[0, 0]))
    assert sigmas[1] - sigmas[0] > 0.08  # 1 m/s less, a tenth of a second unknown; half the way
