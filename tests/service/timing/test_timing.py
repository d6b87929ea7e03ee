"""Frames in, frames with the times that are used out; the mapper behind it is in test_times.py."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import NO_INTENSITY, Frame, GnssFix, LaserScan, OdometrySample
from service.timing import Timing

MS, S = 1_000_000, 1_000_000_000
T0_NS = 1_700_000_000 * S + 7 * MS
TURN_S, STEP_DEG, BEAMS = 0.1, 1.0, 271
BEAM_NS = round(TURN_S * 1e9 / 360)
SWEEP_NS = BEAM_NS * (BEAMS - 1)
RANGES = np.ones(BEAMS, np.float32)


def scan(k: int, stamp_ns: int | None = None, sensor: str = "front") -> LaserScan:
    """The k-th of a laser that turns ten times a second and sees 270 deg, logged when its sweep is over."""
    at_ns = T0_NS + k * 100 * MS
    return LaserScan(
        sensor, at_ns if stamp_ns is None else stamp_ns, at_ns + SWEEP_NS + 2 * MS, BEAM_NS, 100 * MS,
        math.radians(-135.0), math.radians(STEP_DEG), 0.05, 30.0, RANGES, NO_INTENSITY,
    )  # fmt: skip


def sample(k: int, off_ns: int = 0) -> OdometrySample:
    """The k-th of 20 a second, its stamp off by so much."""
    at_ns = T0_NS + k * 50 * MS
    return OdometrySample("base", at_ns + off_ns, at_ns + 2 * MS, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0,) * 9)


def by_log_time(*frames: Frame) -> list[Frame]:
    return sorted(frames, key=lambda frame: frame.arrived_ns)


def drive(off_ns: int = 0) -> list[Frame]:
    """Six seconds."""
    return by_log_time(*[scan(k) for k in range(60)], *[sample(k, off_ns) for k in range(120)])


class Run:
    """Frames through a Timing, to their end."""

    def __init__(self, frames: list[Frame]) -> None:
        self.counters: Counter[str] = Counter()
        self.timing = Timing(["front"], self.counters)
        self.steps = [[one for one, _ in self.timing.take(frame)] for frame in frames]
        self.steps.append([one for one, _ in self.timing.finish()])
        self.frames = [frame for step in self.steps for frame in step]
        self.warnings = self.timing.warnings

    def of(self, kind: type[Frame]) -> list[Frame]:
        return [frame for frame in self.frames if isinstance(frame, kind)]


def test_frames_with_right_times_pass_as_they_are_and_at_once():
    frames = drive()
    run = Run(frames)
    assert run.frames == frames  # the very same objects: frames compare by identity or by all values
    first = next(k for k, frame in enumerate(frames) if isinstance(frame, LaserScan))
    assert [len(step) for step in run.steps[:-1]] == [0] * first + [first + 1] + [1] * (
        len(frames) - first - 1
    )
    assert (run.warnings, run.counters) == ([], Counter())


@pytest.mark.parametrize("off_s", [1.9, -1.9, 253.0, -96 * 86_400.0])
def test_a_constant_offset_of_a_topic_is_found_and_taken_out(off_s: float):
    run = Run(drive(round(off_s * S)))
    assert run.of(OdometrySample) == [sample(k) for k in range(120)]
    assert [frame.stamp_ns for frame in run.of(LaserScan)] == [scan(k).stamp_ns for k in range(60)]
    (warning,) = run.warnings
    direction = "ahead of" if off_s > 0 else "behind"
    assert warning.startswith(f"/base/odom: its stamps are {abs(off_s):.3f} s")
    assert f"{direction} those of the other topics" in warning
    assert "(uncertainty 0.005 s)" in warning


def is_scan(frame: Frame) -> bool:
    return isinstance(frame, LaserScan)


def is_sample(frame: Frame) -> bool:
    return isinstance(frame, OdometrySample)


def is_of_middle(frame: Frame) -> bool:
    return isinstance(frame, LaserScan) and scan(20).stamp_ns <= frame.stamp_ns < scan(40).stamp_ns


def is_frame(frame: Frame) -> bool:
    return True


def changed(of: Callable[[Frame], bool], stamp_ns: int = 0, arrived_ns: int = 0) -> list[Frame]:
    """The drive, with later times of some frames, by log time."""
    return by_log_time(
        *[
            replace(f, stamp_ns=f.stamp_ns + stamp_ns, arrived_ns=f.arrived_ns + arrived_ns) if of(f) else f
            for f in drive()
        ]
    )


@pytest.mark.parametrize(
    ("frames", "warned"),
    [
        (changed(is_scan, stamp_ns=-253 * S), ["/front/scan: its stamps are 253.000 s behind"]),
        (
            changed(is_of_middle, stamp_ns=-108 * MS),
            ["/front/scan: its clock was set 2 times, first by -0.108 s, by 0.000 s in all"],
        ),
        (changed(is_of_middle, arrived_ns=90 * MS), []),
        (changed(is_sample, arrived_ns=200 * MS), []),
        (
            changed(is_sample, arrived_ns=300 * MS),
            ["/base/odom: its messages come at least 0.302 s after their stamps by the log; the stamps are"],
        ),
        (changed(is_frame, arrived_ns=10**8 * S), []),
    ],
    ids=["scans offset", "clock set", "scans late", "latency", "high latency", "logged years later"],
)
def test_stamps_are_corrected_where_the_clock_was_wrong_and_not_where_messages_are_late(
    frames: list[Frame], warned: list[str]
):
    run = Run(frames)
    assert [frame.stamp_ns for frame in run.of(LaserScan)] == [scan(k).stamp_ns for k in range(60)]
    assert [frame.stamp_ns for frame in run.of(OdometrySample)] == [sample(k).stamp_ns for k in range(120)]
    assert [w[: len(start)] for w, start in zip(run.warnings, warned, strict=True)] == warned


def test_without_an_offset_to_be_found_the_topic_is_left_out_whole():
    frames = [
        replace(f, stamp_ns=T0_NS + k * 7 * S) if isinstance(f, OdometrySample) else f
        for k, f in enumerate(drive())
    ]
    run = Run(frames)
    assert run.frames == [frame for frame in frames if isinstance(frame, LaserScan)]
    inconsistent, dropped = run.warnings
    assert inconsistent.startswith("/base/odom: its stamps neither keep to the log times nor have a constant")
    assert dropped.startswith("/base/odom: 120 of 120 (100.0 %) messages are dropped")
    assert run.counters == Counter(samples_dropped_clock=120)


@pytest.mark.parametrize(
    ("off_s", "warning"),
    [
        (-253, "/base/odom: 120 of 120 (100.0 %) messages are dropped: 120 long before the first scan"),
        (253, "/base/odom: all 120 messages came after the last scan"),
    ],
)
def test_a_topic_that_ends_before_the_scans_or_begins_after_them_is_a_warning(off_s: int, warning: str):
    run = Run(changed(is_sample, off_s * S, off_s * S))
    assert [w[: len(warning)] for w in run.warnings] == [warning]
    if off_s < 0:
        assert run.of(OdometrySample) == []


@pytest.mark.parametrize("k", [0, 1, 40])
def test_one_sample_ahead_of_time_is_dropped_and_no_other(k: int):
    frames = drive()
    odd = next(frame for frame in frames if frame == sample(k))
    run = Run([replace(odd, stamp_ns=odd.stamp_ns + 3 * S) if frame is odd else frame for frame in frames])
    assert run.frames == [frame for frame in frames if frame is not odd]
    assert (run.counters, run.warnings) == (Counter(samples_dropped_stamp=1), [])


def test_more_than_five_per_cent_dropped_is_a_warning_with_its_causes():
    def stamp_ns(k: int) -> int:
        years_off, swapped = k % 10 == 3, k == 8
        return T0_NS + k * 100 * MS + years_off * 94_608_000 * S - swapped * 200 * MS

    run = Run([scan(k, stamp_ns(k)) for k in range(60)])
    assert run.warnings == [
        "/front/scan: 7 of 60 (11.7 %) messages are dropped: 6 with a stamp far from those around it, "
        "1 out of order"
    ]
    assert run.counters == Counter(scans_dropped_stamp=6, scans_dropped_late=1)
    assert len(run.frames) == 53


@pytest.mark.parametrize("coarse_ns", [10**12 * S, S])
def test_log_times_serve_where_scans_have_no_stamps_of_their_own(coarse_ns: int):
    run = Run(
        by_log_time(
            *[scan(k, scan(k).stamp_ns // coarse_ns * coarse_ns) for k in range(60)], *map(sample, range(120))
        )
    )
    assert [frame.stamp_ns for frame in run.of(LaserScan)] == [scan(k).stamp_ns for k in range(60)]
    (warning,) = run.warnings
    assert warning.startswith("/front/scan: ")
    assert "their log times are used instead, less the time of a sweep" in warning


def test_messages_that_come_twice_are_dropped_and_their_stamps_are_used():
    twice = [[scan(k), replace(scan(k), arrived_ns=scan(k).arrived_ns + MS)] for k in range(60)]
    run = Run([frame for pair in twice for frame in pair])
    assert [frame.stamp_ns for frame in run.frames] == [scan(k).stamp_ns for k in range(60)]
    assert run.warnings == [
        "/front/scan: 60 of 120 (50.0 %) messages are dropped: 60 with the stamp of the one before"
    ]


def test_the_offset_of_a_topic_that_was_recorded_twice_is_taken_out():
    samples = [sample(k, 253 * S) for k in range(120)]
    copies = [replace(one, arrived_ns=one.arrived_ns + MS) for one in samples]
    run = Run(by_log_time(*map(scan, range(60)), *samples, *copies))
    assert run.of(OdometrySample) == [sample(k) for k in range(120)]
    offset, dropped = run.warnings
    assert offset.startswith("/base/odom: its stamps are 253.000 s ahead of those of the other topics")
    assert dropped.endswith("120 with the stamp of the one before")


def test_a_clock_that_is_set_while_driving_changes_no_time():
    run = Run(changed(lambda f: is_sample(f) and f.stamp_ns > T0_NS + 3 * S, stamp_ns=5 * S))
    after = [frame.stamp_ns for frame in run.of(OdometrySample)]
    # Ten agree, then it is believed.
    assert after == [sample(k).stamp_ns for k in range(120) if not 61 <= k < 70]
    assert any("/base/odom: its clock was set 1 time, first by 5.000 s" in one for one in run.warnings)


def test_a_log_that_was_late_for_a_while_changes_no_stamp():
    """As where the recorder hung for three seconds."""
    run = Run(changed(lambda f: f.stamp_ns > T0_NS + 2 * S, arrived_ns=3 * S))
    assert {frame.stamp_ns for frame in run.frames} <= {frame.stamp_ns for frame in drive()}
    assert len(run.frames) == len(drive()) - 18  # nine of each topic, until they agree


def test_stamps_that_run_at_another_pace_are_a_warning():
    frames = [
        replace(f, stamp_ns=T0_NS + round((f.stamp_ns - T0_NS) * 0.9)) if isinstance(f, OdometrySample) else f
        for f in drive()
    ]
    (warning,) = Run(frames).warnings
    assert warning.startswith("/base/odom: its stamps run slower than the log, by 0.5")


def test_a_laser_that_is_not_mapped_is_not_waited_for_and_passes():
    others = [replace(scan(k, 0), sensor="rear") for k in range(3)]
    run = Run([*others, scan(3)])
    assert run.frames == [*others, run.frames[-1]]
    assert [len(step) for step in run.steps] == [1, 1, 1, 1, 0]


def test_fixes_are_judged_like_all_topics():
    stamps_ns = [T0_NS + k * 200 * MS for k in range(30)]
    fixes = [
        GnssFix("gps", at_ns - 1800 * S, at_ns + 2 * MS, 0, 48.0, 9.0, 400.0, (1.0,) * 9)
        for at_ns in stamps_ns
    ]
    run = Run(by_log_time(*[scan(k) for k in range(60)], *fixes))
    assert [frame.stamp_ns for frame in run.of(GnssFix)] == stamps_ns
    assert [warning[:9] for warning in run.warnings] == ["/gps/fix:"]


def test_what_live_leaves_out_keeps_its_place_among_the_frames():
    timing = Timing(["front"], Counter())
    assert [(one.frame.arrived_ns, one.is_mapped) for one in timing.take(scan(0), is_mapped=False)] == [
        (scan(0).arrived_ns, False)
    ]
