"""The path by odometry against the matched one, and what a change of a vehicle's velocity costs."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimator.motion import OdometryIncrement
from service.geometry.se2 import SE2
from service.mapper.scan_match.reckoning import Reckoning, SteadyMotion, inertia_cost, largest_inertia_cost
from tests.service.mapper.maps.points import prediction

STEP_NS, STEPS = 20_000_000, 10
MS = 1_000_000
STEP = SE2.exp(0.1, 0.01, 0.05)  # of 100 ms
COVARIANCE = np.diag([0.003**2, 0.003**2, 0.001**2])


@pytest.mark.parametrize(("end_m2", "is_conflict"), [(0.0, True), (0.015**2, True), (0.05**2, False)])
def test_an_extrapolated_end_widens_a_path_once(end_m2: float, is_conflict: bool) -> None:
    """0.2 m by odometry, 0.1 m by the matches: 18 sigmas; 4.6 or 1.4 of both ends of the path."""
    reckoning, usual = Reckoning(), prediction(SE2(), 1e-4 * np.eye(3))
    for k in range(STEPS + 1):
        step = OdometryIncrement(SE2(0.02), 1e-8, 1e-8, end_m2, 0.0)
        seen = replace(usual, increment=step, elapsed_s=0.02)
        conflict = reckoning.add(k * STEP_NS, seen, SE2(0.01 * k))
    assert (conflict is not None) is is_conflict


def driven(*stamps_ms: int) -> SteadyMotion:
    motion = SteadyMotion()
    for stamp_ms in stamps_ms:
        motion.matched(stamp_ms * MS, at(stamp_ms))
    return motion


def at(stamp_ms: float) -> SE2:
    steps = stamp_ms / 100.0
    return SE2(3.0, -2.0, 2.0) @ SE2.exp(0.1 * steps, 0.01 * steps, 0.05 * steps)


def apart(one: SE2, two: SE2) -> tuple[float, float, float]:
    return (one.inverse() @ two).log()


@pytest.mark.parametrize("stamp_ms", [220, 300, 700])
def test_it_goes_on_with_the_twist_between_the_last_two_matches(stamp_ms: int) -> None:
    motion = driven(0, 100, 200)
    motion_pose = motion.pose_at(stamp_ms * MS)
    assert motion_pose is not None
    assert apart(motion_pose, at(stamp_ms)) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_two_lasers_one_right_behind_the_other_make_no_step() -> None:
    motion = driven(0, 100)
    motion.matched(103 * MS, at(103) @ SE2(0.01, 0.0, 0.0))  # 1 cm apart within 3 ms is noise, not 3 m/s
    motion_pose = motion.pose_at(200 * MS)
    assert motion_pose is not None
    forward_m, _, _ = apart(motion_pose, at(200))
    assert abs(forward_m) < 0.025


@pytest.mark.parametrize(("elapsed_s", "least", "most"), [(0.04, 5.0, 20.0), (1.5, 0.0, 0.1)])
def test_a_vehicle_does_not_stop_within_a_scan_but_within_a_second(
    elapsed_s: float, least: float, most: float
) -> None:
    assert inertia_cost(SE2(0.04), SE2(0.04), elapsed_s, COVARIANCE) == 0.0
    assert least <= inertia_cost(SE2(0.04), SE2(-0.03), elapsed_s, COVARIANCE) <= most


def test_a_path_costs_its_largest_change_of_velocity() -> None:
    def path_cost(*x_m: float) -> float:
        return largest_inertia_cost((40 * k * MS, SE2(x), COVARIANCE) for k, x in enumerate(x_m))

    assert path_cost() == path_cost(0.0) == path_cost(0.0, 0.5) == 0.0
    assert path_cost(0.0, 0.06, 0.12, 0.18) == pytest.approx(0.0, abs=1e-9)
    jump = path_cost(0.0, 0.06, 0.15, 0.24, 0.33)  # at once half as fast again
    assert jump > 5.0
    assert path_cost(0.0, 0.06, 0.15, 0.24, 0.30) == pytest.approx(jump)  # and back
