import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Limits, Pause, Spin, Trajectory, plan_drive

LIMITS = Limits(speed_mps=1.2, acceleration_mps2=0.5, lateral_mps2=0.8, turn_rate_radps=1.1)
LOOP = [
    Pause(1.0),
    Follow([(6, 0), (6, 4), (0, 4), (-2, 0), (0, 0)], corner_radius_m=0.7),
    Spin(-2.0),
    Pause(0.5),
    Spin(2.0),
]


@pytest.fixture(scope="module")
def loop() -> Trajectory:
    return plan_drive(SE2(0.0, 0.0, 0.3), [*LOOP, Spin(0.3)], LIMITS, repeats=True)


def test_pose_is_continuous_and_twist_is_its_derivative(loop: Trajectory):
    time_s = np.arange(0.0, 2.2 * loop.duration_s, 0.003)
    h = 1e-4
    slope = (loop.poses(time_s + h) - loop.poses(time_s - h)) / (2 * h)
    speed, turn_rate = loop.twists(time_s).T
    theta = loop.poses(time_s)[:, 2]
    np.testing.assert_allclose(slope[:, 0], speed * np.cos(theta), atol=2e-3)
    np.testing.assert_allclose(slope[:, 1], speed * np.sin(theta), atol=2e-3)
    np.testing.assert_allclose(slope[:, 2], turn_rate, atol=2e-3)


def test_speed_acceleration_and_turn_rate_stay_within_limits(loop: Trajectory):
    time_s = np.arange(0.0, loop.duration_s, 0.002)
    speed, turn_rate = loop.twists(time_s).T
    assert speed.max() == pytest.approx(LIMITS.speed_mps, rel=1e-3)
    assert speed.min() > -1e-6
    assert np.abs(turn_rate).max() < 1.02 * LIMITS.turn_rate_radps
    assert np.abs(np.diff(speed) / 0.002).max() < 1.1 * LIMITS.acceleration_mps2
    assert np.abs(np.diff(turn_rate) / 0.002).max() < 4.0  # no step of the turn rate at a corner


def test_travel_adds_up_over_laps(loop: Trajectory):
    one, two = loop.travel(np.array([loop.duration_s - 1e-9, 2 * loop.duration_s - 1e-9]))
    assert one[0] == pytest.approx(loop.length_m, abs=1e-6)
    np.testing.assert_allclose(two, 2 * one, atol=1e-6)
    assert one[1] == pytest.approx(2 * math.pi, abs=1e-6)


def test_corner_passes_inside_the_waypoint_as_far_as_the_radius_requires():
    radius_m = 2.0
    drive = plan_drive(SE2(), [Follow([(8, 0), (8, 8)], corner_radius_m=radius_m)])
    poses = drive.poses(np.arange(0.0, drive.duration_s, 0.01))
    gap_m = np.hypot(poses[:, 0] - 8, poses[:, 1]).min()
    assert gap_m == pytest.approx((math.sqrt(2) - 1) * radius_m, abs=0.01)
    np.testing.assert_allclose(poses[-1], [8, 8, math.pi / 2], atol=1e-3)


def test_open_drive_that_should_repeat_is_refused():
    with pytest.raises(ValueError, match=r"ends 3\.0.* m, .* from its start"):
        plan_drive(SE2(), [Follow([(3, 0)])], repeats=True)


def test_corner_too_wide_for_its_leg_is_refused():
    with pytest.raises(ValueError, match=r"corners need .* m; take a smaller corner radius"):
        plan_drive(SE2(), [Follow([(1, 0), (1, 1), (0, 1)], corner_radius_m=0.9)])
