"""A good drive with the times of one topic damaged, mapped by the default profile."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.service.timing.damages import (
    BEGAN_NS,
    KINDS,
    TOPICS,
    Damage,
    Mapped,
    S,
    damaged,
    good_drive,
    mapped,
)
from tests.soaked import examples

WORSE = 1.5  # times the error of the good drive, without a warning
MAX_DROPPED = 0.05


@cache
def good() -> Mapped:
    return mapped(good_drive()[0])


def offset(seconds: float) -> Damage:
    return lambda k, frame: _stamped(frame, frame.stamp_ns + round(seconds * S))


def scaled_by(factor: float) -> Damage:
    return lambda k, frame: _stamped(frame, BEGAN_NS + round((frame.stamp_ns - BEGAN_NS) * factor))


def every(n: int, first: int, seconds: float) -> Damage:
    return lambda k, frame: offset(seconds)(k, frame) if k % n == first % n else frame


def between(first: int, end: int, seconds: float) -> Damage:
    return lambda k, frame: offset(seconds)(k, frame) if first <= k < end else frame


def zero(n: int) -> Damage:
    return lambda k, frame: _stamped(frame, 0) if k % n == 0 else frame


def coarse(resolution_ms: int, add_ms: int) -> Damage:
    def cut(k: int, frame: Any) -> Any:
        return _stamped(frame, (frame.stamp_ns // 10**6 + add_ms) // resolution_ms * resolution_ms * 10**6)

    return cut


def swapped(n: int, period_ns: int) -> Damage:
    """The second of each n has the stamp of the next, and that has its."""
    return lambda k, frame: _stamped(frame, frame.stamp_ns + period_ns * ((k % n == 1) - (k % n == 2 % n)))


def fields(increment: float, scan_time: float) -> Damage:
    return lambda k, frame: replace(
        frame,
        beam_interval_ns=round(frame.beam_interval_ns * increment),
        scan_period_ns=round(frame.scan_period_ns * scan_time),
    )


def _stamped(frame: Any, stamp_ns: int) -> Any:
    return replace(frame, stamp_ns=max(stamp_ns, 0))


PERIODS_NS = {"scan": S // 10, "odom": 15_000_000, "imu": 5_000_000}
away = st.one_of(
    st.floats(-2.0, 2.0),
    st.sampled_from([-96 * 86_400.0, 253.0, -253.0, 3 * 31_536_000.0]),
    st.floats(-1e8, 1e8),
)
ratios = st.one_of(
    st.sampled_from([1e-3, 1 / 20, 1 / 3, 1.0, 3.0, 240.0, 1e3, 1e6, 1e9]),
    st.floats(-3.0, 3.0).map(lambda exponent: 10.0**exponent),
)
stamp_damages = st.one_of(
    st.builds(offset, away),
    st.builds(scaled_by, st.one_of(st.floats(0.2, 5.0), st.sampled_from([1e-9, 1e-3, 0.99, 1.01, 1e3]))),
    st.builds(every, st.integers(1, 40), st.integers(0, 40), away),
    st.builds(between, st.integers(0, 60), st.integers(1, 90), away),
    st.builds(zero, st.integers(1, 30)),
    st.builds(coarse, st.sampled_from([5, 20, 50, 100, 200, 500, 1000, 10_000]), st.integers(0, 999)),
)


@st.composite
def damages(draw: Callable[[Any], Any]) -> tuple[str, Damage]:
    kind = draw(st.sampled_from(sorted(KINDS)))
    of_stamps = st.one_of(stamp_damages, st.builds(swapped, st.integers(2, 30), st.just(PERIODS_NS[kind])))
    # an increment of 0 is a warning of who reads the recording
    of_fields = st.builds(fields, ratios, st.one_of(st.just(0.0), ratios))
    return kind, draw(st.one_of(of_stamps, of_fields) if kind == "scan" else of_stamps)


@example(("scan", offset(-0.9)))  # no more than a slow link, by the log times
@example(("odom", swapped(2, 15_000_000)))
@example(("scan", fields(1 / 3, 1.0)))
@given(damages())
@settings(max_examples=examples(5), suppress_health_check=[HealthCheck.too_slow])
def test_damaged_times_are_mended_or_the_topic_is_named(damage: tuple[str, Damage]):
    kind, change = damage
    run = mapped(damaged(kind, change))
    count = sum(isinstance(frame, KINDS[kind]) for frame in good_drive()[0])
    is_named = any(
        warning.startswith(TOPICS[kind]) or f" {TOPICS[kind]} " in warning for warning in run.warnings
    )
    assert is_named or run.error_m <= WORSE * good().error_m
    assert is_named or run.dropped[kind] <= MAX_DROPPED * count


def test_the_good_drive_is_mapped_well_without_a_warning():
    assert good().error_m < 0.004
    assert (good().warnings, sum(good().dropped.values())) == ([], 0)
