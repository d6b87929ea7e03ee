"""What odometry says of the mounting of the lasers."""

import math
import re
from collections.abc import Callable

import numpy as np
import pytest

from drivers.frames import OdometrySample
from service.geometry.se2 import SE2
from service.mapper.checks.odometry_mounting import STEPS, OdometryMounting, fault_of
from service.mapper.checks.stamp_check import BATCH

SCAN_NS, LATE_NS = 20_000_000, 7_000_000  # odometry is sampled between scans


def path(seconds: float) -> Callable[[float], SE2]:
    """0.5 m/s, turning to one side and the other."""
    at_s = np.arange(0.0, seconds + 0.1, 0.001)
    heading = 1.2 * np.sin(0.4 * at_s)
    x_m, y_m = 0.0005 * np.cumsum(np.cos(heading)), 0.0005 * np.cumsum(np.sin(heading))
    return lambda t_s: SE2(*(float(np.interp(t_s, at_s, one)) for one in (x_m, y_m, heading)))


def drive(
    offset: SE2,
    seconds: float,
    check: OdometryMounting,
    first_s: float = 0.0,
    noise_m: float = 0.0,
    sample_each: int = 1,
    late_s: float = 0.0,
    seed: int = 1,
) -> set[str]:
    """Scans and odometry of a vehicle whose base as configured sits at the offset in that of odometry.

    Returns the faults at any time, "" among them where there was none.
    """
    faults = set()
    true, random = path(seconds), np.random.default_rng(seed)
    for k in range(int(seconds * 1e9 / SCAN_NS)):
        stamp_ns = round(first_s * 1e9) + k * SCAN_NS
        at = true(k * SCAN_NS * 1e-9)
        off = SE2(*random.normal(0.0, noise_m, 2).tolist(), 0.0)
        check.add_pose(stamp_ns, at @ offset @ off)
        if k % sample_each == 0:
            check.add_odometry(sample(stamp_ns + LATE_NS, true((k * SCAN_NS + LATE_NS) * 1e-9 - late_s)))
        faults.add(str(check.fault))
    return faults


def sample(stamp_ns: int, pose: SE2) -> OdometrySample:
    twist, covariance = (0.0, 0.0, 0.0), (0.0,) * 9
    return OdometrySample("base", stamp_ns, stamp_ns, pose.x_m, pose.y_m, pose.theta_rad, twist, covariance)


@pytest.mark.parametrize(
    ("offset", "sample_each", "reported"),
    [
        (SE2(0.0, 0.0, math.radians(-3.0)), 1, r"drives 3\.0 deg to the left"),
        (SE2(0.0, 0.0, math.radians(4.0)), 1, r"drives 4\.0 deg to the right"),
        # between the samples odometry goes on
        (SE2(0.0, 0.0, math.radians(3.0)), 10, r"drives 3\.0 deg to the right of its heading \(sigma 0\.3\)"),
        (SE2(-0.3, 0.0, 0.0), 1, r"around a point \+0\.30 m ahead and \+0\.00 m left"),
        (SE2(0.0, 0.25, 0.0), 1, r"around a point \+0\.00 m ahead and -0\.25 m left"),
    ],
)
def test_a_wrong_mounting_is_reported_with_its_figures(offset: SE2, sample_each: int, reported: str):
    check = OdometryMounting()
    drive(offset, 60.0, check, sample_each=sample_each)
    assert re.search(reported, check.fault), check.fault
    assert "corridor calibrate" in check.fault


@pytest.mark.parametrize(("yaw_deg", "seconds"), [(180.0, 0.9), (30.0, 1.8), (6.0, 8.0)])
def test_a_mounting_that_is_far_off_is_reported_within_metres(yaw_deg: float, seconds: float):
    check = OdometryMounting()
    drive(SE2(0.0, 0.0, math.radians(yaw_deg)), seconds, check, noise_m=0.01)
    assert "by odometry the vehicle drives" in check.fault


@pytest.mark.parametrize(
    ("offset", "seconds", "noise_m"),
    [
        (SE2(), 60.0, 0.03),  # errors of scan matching
        (SE2(0.03, -0.03, math.radians(0.5)), 90.0, 0.0),  # of a mounting measured by hand
        *[(SE2(0.0, 0.0, math.radians(0.5)), seconds, 0.02) for seconds in (0.9, 2.0, 5.0, 13.0)],
    ],
)
def test_noise_and_tolerances_of_a_mounting_make_no_fault(offset: SE2, seconds: float, noise_m: float):
    check = OdometryMounting()
    drive(offset, seconds, check, noise_m=noise_m)
    assert check.fault == ""


@pytest.mark.parametrize("seed", [0, 1, 3])
def test_few_steps_after_another_mounting_do_not_forget_the_noise(seed: int):
    """Three times the assumed one, so that the newest steps now and then seem to show another mounting."""
    assert drive(SE2(), 120.0, OdometryMounting(), noise_m=0.03, seed=seed) == {""}


def test_a_pause_of_odometry_or_scans_makes_no_step():
    check = OdometryMounting()
    for k in range(2 * BATCH):  # a metre to the side in each pause of odometry
        stamp_ns = k * 2_000_000_000
        check.add_odometry(sample(stamp_ns, SE2(float(k), 0.0, 0.0)))
        check.add_pose(stamp_ns - 1_000_000_000, SE2(float(k), float(k), 0.0))
    for k in range(16 * BATCH):  # and in one of the scans
        stamp_ns = 1_000_000_000_000 + k * 500_000_000
        check.add_odometry(sample(stamp_ns, SE2(float(k), 0.0, 0.0)))
        if k % 8 == 0:
            check.add_pose(stamp_ns, SE2(float(k), float(k), 0.0))
    assert check.fault == ""


def test_a_mounting_that_is_right_again_is_believed():
    check = OdometryMounting()
    drive(SE2(0.0, 0.0, math.radians(10.0)), STEPS * 0.8, check)
    assert check.fault
    check.interrupt()
    drive(SE2(), STEPS * 0.8, check, first_s=1000.0)
    assert check.fault == ""


@pytest.mark.parametrize("yaw_deg", [5.0, -6.0])
def test_a_laser_that_is_knocked_and_set_right_again_is_reported_within_metres(yaw_deg: float):
    check = OdometryMounting()
    drive(SE2(), 60.0, check, noise_m=0.005)
    drive(SE2(0.0, 0.0, math.radians(yaw_deg)), 9.0, check, first_s=100.0, noise_m=0.005)
    assert "by odometry the vehicle drives" in check.fault
    drive(SE2(), 12.0, check, first_s=200.0, noise_m=0.005)
    assert check.fault == ""


def slipping() -> np.ndarray:
    """Each tenth step slides to the right."""
    random = np.random.default_rng(3)
    driven = np.column_stack([np.full(200, 0.2), random.normal(0.0, 0.005, 200)])
    matched = np.column_stack([driven, random.uniform(-0.3, 0.3, 200)])
    matched[::10, 1] -= 0.2
    return np.column_stack([matched, driven, matched[:, 2]])


def noisy_headings() -> np.ndarray:
    """Straight ahead: headings of neighbouring steps err with opposite signs, what lies aside with them."""
    heading = np.random.default_rng(4).normal(0.0, 0.004, 401)
    matched = np.column_stack([np.full(400, 3.0), -3.0 * heading[:-1], np.diff(heading)])
    return np.column_stack([matched, np.full(400, 3.0), np.zeros(400), np.diff(heading)])


def with_late_stamps(count: int) -> np.ndarray:
    """In a curve, each tenth end of a step 0.15 s late at 1.4 m/s; the others by 0.02 s at most."""
    random = np.random.default_rng(6)
    late_m = np.where(np.arange(count + 1) % 10 == 4, 0.2, 0.03 * random.uniform(-1.0, 1.0, count + 1))
    turn_rad = np.where(np.arange(count) % 4 == 0, 0.12, 0.07)
    matched = np.column_stack([np.full(count, 0.35), random.normal(0.0, 0.005, count), turn_rad])
    driven = np.column_stack([0.35 + np.diff(late_m), np.zeros(count), turn_rad])
    return np.column_stack([matched, driven])


DEAD = np.column_stack([np.full(50, 0.2), np.zeros(50), np.full(50, 0.1), np.zeros((50, 3))])


@pytest.mark.parametrize("steps", [slipping(), noisy_headings(), DEAD], ids=["slip", "headings", "dead"])
def test_errors_of_odometry_show_no_mounting(steps: np.ndarray):
    assert fault_of(steps) == ""


def test_late_stamps_in_a_curve_show_no_mounting():
    assert {fault_of(with_late_stamps(count)) for count in range(5, 80)} == {""}


@pytest.mark.parametrize(("is_mirrored", "is_named"), [(True, True), (False, False)])
def test_a_laser_that_is_mounted_upside_down_contrary_to_its_config_is_named(is_mirrored, is_named):
    """Its scans turn against odometry; the map alone is as good as the right one."""
    true, check = path(40.0), OdometryMounting()
    for k in range(2000):
        stamp_ns, pose = k * SCAN_NS, true(k * SCAN_NS * 1e-9)
        seen = SE2(pose.x_m, -pose.y_m, -pose.theta_rad) if is_mirrored else pose
        check.add_odometry(sample(stamp_ns, pose))
        check.add_pose(stamp_ns, seen)
    assert check.fault.startswith("odometry turns the other way than the scans") is is_named
    assert bool(check.fault) is is_named
