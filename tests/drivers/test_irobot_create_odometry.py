import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.irobot_create.odometry import DeadReckoning, counts_between

BASE_M = 0.235


def reckoning(variance: float = 1e-4) -> DeadReckoning:
    return DeadReckoning(BASE_M, variance)


@given(st.integers(0, 65_535), st.integers(-32_768, 32_767))
def test_any_step_within_half_a_turn_of_the_counter_is_found(old: int, step: int):
    assert counts_between(old, (old + step) % 65_536) == step


def by_small_steps(left_m: float, right_m: float, theta_rad: float) -> tuple[float, float, float]:
    """The same motion in a million straight bits, by the midpoint rule."""
    n = 1_000_000
    ds, dth = 0.5 * (left_m + right_m) / n, (right_m - left_m) / BASE_M / n
    headings = theta_rad + dth * (np.arange(n) + 0.5)
    return float(ds * np.cos(headings).sum()), float(ds * np.sin(headings).sum()), theta_rad + n * dth


@pytest.mark.parametrize(
    ("left_m", "right_m"),
    [(0.3, 0.5), (0.5, 0.3), (-0.2, 0.2), (-0.4, -0.1), (0.4, 0.4 + 1e-8), (0.4, 0.4), (0.0, 0.7)],
)
def test_arc_agrees_with_a_fine_integration(left_m: float, right_m: float):
    odometry = reckoning()
    odometry.roll(-0.1, 0.1)
    start = odometry.theta_rad
    expected = by_small_steps(left_m, right_m, start)
    odometry.roll(left_m, right_m)
    assert (odometry.x_m, odometry.y_m) == pytest.approx(expected[:2], abs=1e-10)
    assert math.remainder(odometry.theta_rad - expected[2], math.tau) == pytest.approx(0.0, abs=1e-12)


def test_covariance_agrees_with_ten_thousand_noisy_drives():
    variance = 2e-6
    rng = np.random.default_rng(7)
    steps = [(0.010, 0.012)] * 60 + [(0.012, 0.009)] * 60
    odometry = reckoning(variance)
    for left_m, right_m in steps:
        odometry.roll(left_m, right_m)
    x, y, theta = np.zeros(10_000), np.zeros(10_000), np.zeros(10_000)
    for left_m, right_m in steps:
        left = left_m + rng.normal(0.0, math.sqrt(variance * left_m), x.shape)
        right = right_m + rng.normal(0.0, math.sqrt(variance * right_m), x.shape)
        ds, dth = 0.5 * (left + right), (right - left) / BASE_M
        x += ds * np.cos(theta + 0.5 * dth)
        y += ds * np.sin(theta + 0.5 * dth)
        theta += dth
    sampled = np.cov(np.vstack([x, y, theta]))
    claimed = np.array(odometry.covariance).reshape(3, 3)
    scale = np.sqrt(np.outer(np.diag(claimed), np.diag(claimed)))
    np.testing.assert_allclose(claimed / scale, sampled / scale, atol=0.05)


def test_lost_time_widens_without_moving():
    odometry = reckoning()
    odometry.roll(0.1, 0.2)
    pose, before = (odometry.x_m, odometry.y_m, odometry.theta_rad), odometry.covariance
    odometry.lose(0.1)
    assert (odometry.x_m, odometry.y_m, odometry.theta_rad) == pose
    assert odometry.covariance[0] - before[0] == pytest.approx(0.05**2 / 3)
    assert odometry.covariance[8] - before[8] == pytest.approx(2 * 0.05**2 / 3 / BASE_M**2)
