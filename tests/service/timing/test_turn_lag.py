"""Headings of scans and turns of a source, both of one weaving drive."""

import math

import pytest

from service.timing.turn_lag import FIRST_JUDGED, Lag, TurnLag

MS, S = 1_000_000, 1_000_000_000


def heading_rad(at_ns: int) -> float:
    """Of a drive through bends of several lengths."""
    t = at_ns * 1e-9
    return 0.6 * math.sin(0.9 * t) + 0.4 * math.sin(0.37 * t + 1.0)


def lag_of(off_ns: int, scale: float = 1.0, bias_radps: float = 0.0, straight: bool = False) -> Lag | None:
    turns = TurnLag()
    for k in range(1000):
        at_ns = k * 20 * MS
        turn = 0.0 if straight else scale * heading_rad(at_ns)
        turns.add_sample(at_ns + off_ns, math.remainder(turn + bias_radps * at_ns * 1e-9, math.tau))
    found = None
    for k in range(2 * FIRST_JUDGED):
        at_ns = 2 * S + k * 100 * MS
        found = turns.add_scan(at_ns, 0.0 if straight else heading_rad(at_ns)) or found
    return found


@pytest.mark.parametrize("off_s", [-0.9, -0.2, -0.05, 0.05, 0.4, 0.9])
def test_the_offset_of_the_stamps_is_found(off_s: float):
    lag = lag_of(round(off_s * S), scale=0.9, bias_radps=0.02)
    assert lag.lag_s == pytest.approx(off_s, abs=3e-3)
    assert lag.sigma_s < 5e-3


def test_stamps_that_are_right_and_a_straight_drive_show_no_offset():
    assert lag_of(0) is None
    assert lag_of(400 * MS, straight=True) is None


def test_an_offset_beyond_the_search_is_not_taken_for_another():
    assert lag_of(5 * S) is None


@pytest.mark.parametrize("turned_at", [0, FIRST_JUDGED // 2, FIRST_JUDGED - 2])
def test_a_heading_that_jumps_once_shows_no_offset(turned_at: int):
    """All of what was turned lies between two scans: one of the halves that are compared has none."""
    turns = TurnLag()
    for k in range(1000):
        turns.add_sample(k * 20 * MS, heading_rad(k * 20 * MS))
    found = [turns.add_scan(2 * S + k * 100 * MS, float(k > turned_at)) for k in range(FIRST_JUDGED)]
    assert set(found) == {None}


def test_scans_that_lie_nowhere_are_left_out():
    turns = TurnLag()
    for k in range(1000):
        turns.add_sample(k * 20 * MS + 300 * MS, heading_rad(k * 20 * MS))
    found = [
        turns.add_scan(at_ns, math.nan if k % 10 == 0 else heading_rad(at_ns))
        for k in range(2 * FIRST_JUDGED)
        for at_ns in [2 * S + k * 100 * MS]
    ]
    (lag,) = [one for one in found if one is not None and one.scans > 50]
    assert lag.lag_s == pytest.approx(0.3, abs=3e-3)
