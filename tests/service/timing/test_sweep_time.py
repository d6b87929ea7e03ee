"""time_increment, scan_time and the period of the scans."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, LaserScan
from service.timing import Timing

MS, S = 1_000_000, 1_000_000_000


def scan(
    k: int = 0,
    turn_s: float = 0.1,
    reported_s: float = 0.1,
    step_deg: float = 1.5,
    beams: int = 180,
    period_s: float = 0.1,
) -> LaserScan:
    """The k-th. Fields that say a turn of turn_s, with a scan_time of reported_s; one each period_s."""
    at_ns = round(k * period_s * S) + 3 * MS
    beam_ns = round(turn_s * 1e9 * step_deg / 360.0)
    return LaserScan(
        "front", at_ns, at_ns + 100 * MS, beam_ns, round(reported_s * 1e9), -2.0,
        math.radians(step_deg), 0.05, 30.0, np.ones(beams, np.float32), NO_INTENSITY,
    )  # fmt: skip


def used(**fields: float) -> tuple[list[LaserScan], list[str]]:
    timing = Timing(["front"], Counter())
    frames = [one for k in range(40) for one, _ in timing.take(scan(k, **fields))]  # type: ignore[arg-type]
    frames += [one for one, _ in timing.finish()]
    return frames, timing.warnings  # type: ignore[return-value]


@pytest.mark.parametrize(
    "turn_s",
    [0.1 * 1e9, 0.1 / (1.5 / 360.0), 0.1 / 3, 0.1 / 20, 0.1 / 1000],
    ids=["in ns", "equal to scan_time", "a third", "a twentieth", "a thousandth"],
)
@pytest.mark.parametrize("reported_s", [0.1, 0.0], ids=["with scan_time", "without"])
def test_an_impossible_time_increment_is_replaced_by_that_of_the_period(turn_s: float, reported_s: float):
    frames, (warning,) = used(turn_s=turn_s, reported_s=reported_s)
    assert warning.startswith("/front/scan: time_increment ")
    if turn_s == 0.1 / 3 and not reported_s:
        assert "either the other turns are left out, or time_increment is wrong" in warning
        return  # nothing tells which
    assert len(frames) == 40
    assert {frame.beam_interval_ns for frame in frames} == {scan().beam_interval_ns}
    assert {frame.scan_period_ns for frame in frames} == {100 * MS}
    assert "scans come each 100 ms" in warning
    assert "time_increment 416.7 us" in warning


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"reported_s": 0.0},
        {"turn_s": 0.0},  # an instant, which has its own warning
        {"turn_s": 0.097},  # a motor that turns a little faster
        {"turn_s": 1 / 75, "reported_s": 0.235, "period_s": 0.235, "step_deg": 0.5, "beams": 360},  # LMS2xx
        {"turn_s": 2 / 75, "reported_s": 0.0533, "period_s": 0.0533, "step_deg": 0.5, "beams": 361},
        {"turn_s": 1 / 25, "period_s": 0.1, "step_deg": 0.5, "beams": 361},  # LMS1xx, two of five scans
        {"turn_s": 0.6, "reported_s": 0.6, "period_s": 0.1, "step_deg": 1.0, "beams": 60},  # sectors
    ],
)
def test_fields_of_lasers_that_exist_are_believed_without_a_word(fields: dict[str, float]):
    frames, warnings = used(**fields)
    assert warnings == []
    beam_ns = scan(**fields).beam_interval_ns  # type: ignore[arg-type]
    assert {frame.beam_interval_ns for frame in frames} == {beam_ns}


BELIEVED = {"turn_s": 0.1 * 360.0 / 270.0}  # a sweep of 270 deg that fills the period


@pytest.mark.parametrize(
    ("fields", "words", "used_fields"),
    [
        ({"period_s": 0.5}, "scans come each 500 ms: either the other turns are left out", {}),
        (BELIEVED, "should be scan_time * angle_increment / 360 deg", BELIEVED),
        ({"reported_s": 5.0}, "scan_time is wrong", {}),
        ({"turn_s": 0.3, "reported_s": 0.3}, "time_increment cannot be true", {}),
    ],
    ids=["turns left out", "sweep fills the period", "scan_time", "fields agree, not with the period"],
)
def test_inconsistent_fields_are_reported(
    fields: dict[str, float], words: str, used_fields: dict[str, float]
):
    frames, (warning,) = used(**fields)
    assert words in warning
    assert frames[-1].beam_interval_ns == scan(**used_fields).beam_interval_ns  # type: ignore[arg-type]
    if "reported_s" in fields:
        assert frames[-1].scan_period_ns == 100 * MS


def test_one_scan_with_another_time_increment_gets_that_of_the_others():
    timing = Timing(["front"], Counter())
    odd = replace(scan(7), beam_interval_ns=20 * scan(7).beam_interval_ns)
    frames = [one for k in range(20) for one, _ in timing.take(odd if k == 7 else scan(k))]
    assert {frame.beam_interval_ns for frame in frames if isinstance(frame, LaserScan)} == {
        scan().beam_interval_ns
    }
    (warning,) = timing.warnings
    assert warning.startswith("/front/scan: 1 scan with a time_increment that contradicts that of the others")
