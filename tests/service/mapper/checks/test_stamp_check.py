"""Stamps of two lasers are compared by the turns of both."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from service.geometry.se2 import wrap_angle
from service.mapper.checks.stamp_check import StampCheck

OTHER_NS, NS = 40_000_000, 66_000_000  # periods


def heading_rad(t_s: float) -> float:
    """Straight ahead and turns of 1 rad/s to both sides, through half a turn, with ramps between."""
    return 3.0 + 1.5 * math.sin(t_s / 1.5) + 0.4 * math.sin(t_s)


def drive(
    check: StampCheck,
    late_s: float,
    from_s: float = 0.0,
    to_s: float = 20.0,
    noise_rad: float = 0.0,
    of: Callable[[float], float] = heading_rad,
    off_rad: float = 0.0,
    other_ns: int = OTHER_NS,
) -> None:
    rng = np.random.default_rng(1)
    scans = [(k * other_ns, True) for k in range(int(from_s * 1e9 / other_ns), int(to_s * 1e9 / other_ns))]
    scans += [(k * NS + 5, False) for k in range(int(from_s * 1e9 / NS), int(to_s * 1e9 / NS))]
    for stamp_ns, is_other in sorted(scans):
        t_s = stamp_ns * 1e-9 - (0.0 if is_other else late_s)
        heading = wrap_angle(of(t_s) + noise_rad * rng.standard_normal() + off_rad * (not is_other))
        if is_other:
            check.add_other(stamp_ns, heading)
        else:
            check.add(stamp_ns, heading)


@pytest.mark.parametrize("late_s", [0.03, 0.1, -0.06])
def test_late_stamps_are_found_and_measured(late_s):
    check = StampCheck()
    drive(check, late_s, noise_rad=0.002)
    assert check.late_s == pytest.approx(late_s, abs=0.003)
    assert 0.0 < check.sigma_s < 0.005


@pytest.mark.parametrize("late_s", [0.0, 0.008])
def test_stamps_that_go_together_within_what_people_know_are_right(late_s):
    check = StampCheck()
    drive(check, late_s, noise_rad=0.002)
    assert check.late_s == 0.0


def test_a_clock_that_was_set_right_is_cleared_and_one_that_was_set_wrong_found():
    check = StampCheck()
    drive(check, 0.0, to_s=40.0)
    assert check.late_s == 0.0
    drive(check, 0.1, from_s=40.0, to_s=80.0)
    assert check.late_s == pytest.approx(0.1, abs=0.003)
    drive(check, 0.0, from_s=80.0, to_s=120.0)
    assert check.late_s == 0.0


def test_a_mounting_that_is_a_little_off_is_no_lag_in_turns_to_one_side():
    check = StampCheck()
    drive(check, 0.0, of=lambda t_s: 0.4 * t_s + 0.3 * math.sin(t_s), off_rad=math.radians(2.0))
    assert check.late_s == 0.0


def test_scans_around_a_pause_or_a_lost_place_are_not_compared():
    paused, lost = StampCheck(), StampCheck()
    drive(paused, 0.1, other_ns=500_000_000)
    for stamp_ns in range(0, 20_000_000_000, OTHER_NS):
        lost.add_other(stamp_ns, heading_rad(stamp_ns * 1e-9))
        lost.interrupt()
        lost.add(stamp_ns + 1, heading_rad(stamp_ns * 1e-9 - 0.1))
    assert (paused.late_s, lost.late_s) == (0.0, 0.0)
