import numpy as np
import pytest

from service.fusion.wheel_trust import LearntScale, WheelTrust
from service.geometry.se2 import SE2


def trust() -> WheelTrust:
    return WheelTrust(window_m=0.5, window_rad=1.0, scale_sigma=0.01, walk=(0.02, 0.01))


def roll(trust: WheelTrust, steps: int, scale: float, turn_scale: float = 1.0, seed: int = 1) -> None:
    """Steps of 5 cm and 2 deg; the walls are right to a millimetre."""
    noise = np.random.default_rng(seed)
    for _ in range(steps):
        true = SE2.exp(0.05 + 0.001 * noise.standard_normal(), 0.0, 0.035)
        trust.learn(SE2.exp(0.05 / scale, 0.0, 0.035 / turn_scale), true, 0.001, 0.001)


def test_both_scales_are_learnt_apart() -> None:
    wheels = trust()
    roll(wheels, 400, 0.97, 1.04)
    assert wheels.scale == pytest.approx(0.97, abs=0.005)
    assert wheels.turn_scale == pytest.approx(1.04, abs=0.01)
    step = wheels.corrected(SE2.exp(1.0, 0.0, 0.5))
    assert step.log() == pytest.approx((wheels.scale, 0.0, 0.5 * wheels.turn_scale), abs=1e-9)


def test_the_sigma_shrinks_with_what_is_learnt() -> None:
    wheels = trust()
    assert wheels.scale_sigma == 0.01
    roll(wheels, 100, 1.0)
    assert wheels.scale_sigma < 0.008


def test_a_moment_of_slip_teaches_nothing() -> None:
    wheels = trust()
    roll(wheels, 400, 1.0)
    for _ in range(20):  # wheels roll a metre, the vehicle stands
        wheels.learn(SE2(0.05, 0.0, 0.0), SE2(), 0.001, 0.001)
    assert wheels.scale == pytest.approx(1.0, abs=0.01)


def test_another_floor_is_learnt_after_three_strange_windows() -> None:
    wheels = trust()
    roll(wheels, 400, 1.0)
    roll(wheels, 40, 0.8)
    assert wheels.scale == pytest.approx(0.8, abs=0.02)


def test_what_the_walls_do_not_show_is_passed_over() -> None:
    wheels = trust()
    for _ in range(400):
        wheels.learn(SE2(0.05, 0.0, 0.0), SE2(0.04, 0.0, 0.0), None, None)
    assert wheels.scale == 1.0
    assert wheels.scale_sigma == 0.01


def test_a_scale_weighs_pairs_by_their_noise() -> None:
    sharp, blunt = LearntScale(0.01), LearntScale(0.01)
    sharp.learn(1.0, 1.02, 0.001)
    blunt.learn(1.0, 1.02, 0.1)
    assert sharp.value == pytest.approx(1.02, abs=0.001)
    assert blunt.value == pytest.approx(1.0, abs=0.001)
