"""Whether a laser's time_increment can be true, by its angle_increment, its scan_time and its period.

A mirror that turns by `angle_increment` in `time_increment` turns once in `turn_s`. That is the period of the
scans, or a part of it where turns are left out. A blind sector shortens the sweep and not the turn.
"""

import math
from dataclasses import dataclass, replace

from drivers.frames import LaserScan

DURATION_TOLERANCE = 0.1  # of two durations that are the same: motors, rounded fields
SHORTEST_TURN_S = 0.009  # no planar laser turns more than 100 times a second
MAX_SWEEPS = 1.05  # of the period: a mirror that swings measures all the time
# Lasers of which logs have other scan_times than their turn: degrees from beam to beam -> s that a turn takes
# by the fields, for SICK LMS2xx (75 Hz; a scan of 0.5 deg is of two turns, of 0.25 deg of four) and LMS1xx
# (25 and 50 Hz).
_LMS2XX = {1.0: (1 / 75,), 0.5: (1 / 75, 2 / 75), 0.25: (1 / 75, 4 / 75)}
_LMS2XX_BEAMS = frozenset({101, 180, 181, 201, 360, 361, 401})  # of an LMS2xx, for each of its fields of view
_LMS1XX = {0.5: (1 / 25, 1 / 50), 0.25: (1 / 25,)}  # step deg -> s a turn, as specified


@dataclass(frozen=True, slots=True)
class SweepTime:
    """The time fields of a laser's scans, judged.

    turn_s     for which its scans are taken; None: their time_increment is believed
    period_s   for which their scan_time is taken; None: it is believed
    finding    what contradicts what, with both figures and what is used; "": nothing does
    """

    turn_s: float | None = None
    period_s: float | None = None
    finding: str = ""

    def used(self, scan: LaserScan) -> LaserScan:
        """The scan with the time fields that are used of it."""
        if self.turn_s is None and self.period_s is None:
            return scan
        interval_ns, period_ns = scan.beam_interval_ns, scan.scan_period_ns
        if self.turn_s is not None:
            interval_ns = round(self.turn_s * 1e9 * abs(scan.angle_step_rad) / math.tau)
        if self.period_s is not None:
            period_ns = round(self.period_s * 1e9)
        return replace(scan, beam_interval_ns=interval_ns, scan_period_ns=period_ns)


BELIEVED = SweepTime()


def turn_s(scan: LaserScan) -> float:
    """In which the mirror turns once, by time_increment and angle_increment; 0: the sweep is one instant."""
    return scan.beam_interval_ns * 1e-9 * math.tau / abs(scan.angle_step_rad)


def sweep_ns(scan: LaserScan) -> int:
    """From the first beam to the last."""
    return scan.beam_interval_ns * (len(scan.range_m) - 1)


def agree_by_themselves(scan: LaserScan) -> bool:
    """Whether the fields of one scan leave no question, whatever the period of the scans is."""
    turn, reported_s = turn_s(scan), scan.scan_period_ns * 1e-9
    if turn == 0.0 or (_is_known_laser(scan) and turn <= reported_s * (1 + DURATION_TOLERANCE)):
        return True
    return turn >= SHORTEST_TURN_S and are_same(turn, reported_s)


def judge(scan: LaserScan, period_s: float | None) -> SweepTime:
    """period_s: from one scan to the next, as measured; None: unknown."""
    turn, reported_s = turn_s(scan), scan.scan_period_ns * 1e-9
    if turn == 0.0 or (
        _is_known_laser(scan) and (period_s is None or turn <= period_s * (1 + DURATION_TOLERANCE))
    ):
        return BELIEVED
    period = period_s or reported_s
    if period == 0.0:
        return SweepTime(0.0, None, f"{_figures(scan)}, and nothing tells the period; {_INSTANT}")
    sweep_s = sweep_ns(scan) * 1e-9
    what = f"{_figures(scan)}; scans come each {_time(period)}"
    if are_same(turn, period):
        if reported_s == 0.0 or are_same(reported_s, period):
            return BELIEVED
        return SweepTime(None, period, f"{what}, so scan_time is wrong and the measured period is used")
    if turn > period and abs(sweep_s / period - 1.0) <= MAX_SWEEPS - 1.0:
        if are_same(turn, reported_s):
            return BELIEVED  # sectors of a turn, each a message
        return SweepTime(None, None, f"{what}, which the sweep of {_time(sweep_s)} fills though {_FILLS}")
    is_reported = are_same(turn, reported_s) or reported_s == 0.0
    if SHORTEST_TURN_S <= turn < period and is_reported:
        return SweepTime(None, None, f"{what}: {_LEFT_OUT}")
    used = f"a turn in {_time(period)} is used (time_increment {_time(period * _share(scan))})"
    return SweepTime(period, period, f"{what}: time_increment cannot be true, and {used}. {_ASK}")


_ASK = "Does its driver set time_increment in s?"
_INSTANT = "all beams count as measured at once"
_FILLS = (
    "it covers less than a turn; time_increment is believed. If this laser's mirror rotates, time_increment "
    "should be scan_time * angle_increment / 360 deg"
)
_LEFT_OUT = (
    "either the other turns are left out, or time_increment is wrong; it is believed. Does scan_time say the "
    "time from one scan of the laser to the next?"
)


def _figures(scan: LaserScan) -> str:
    facts = scan.scan_period_ns * 1e-9
    step_deg = math.degrees(abs(scan.angle_step_rad))
    return (
        f"time_increment {_time(scan.beam_interval_ns * 1e-9)} at {step_deg:.3g} deg a beam is a turn in "
        f"{_time(turn_s(scan))}, scan_time is {_time(facts) if facts else 'not set'}"
    )


def _time(seconds: float) -> str:
    if seconds >= 1.0:
        return f"{seconds:.4g} s"
    return f"{seconds * 1e3:.4g} ms" if seconds >= 1e-3 else f"{seconds * 1e6:.4g} us"


def _share(scan: LaserScan) -> float:
    return abs(scan.angle_step_rad) / math.tau


def are_same(one_s: float, other_s: float) -> bool:
    """Whether two durations are the same within DURATION_TOLERANCE."""
    return abs(one_s - other_s) <= DURATION_TOLERANCE * max(one_s, other_s)


def _is_known_laser(scan: LaserScan) -> bool:
    step_deg = round(math.degrees(abs(scan.angle_step_rad)), 3)
    turns = _LMS1XX.get(step_deg, ())
    if len(scan.range_m) in _LMS2XX_BEAMS:
        turns += _LMS2XX.get(step_deg, ())
    return any(abs(turn_s(scan) - turn) <= 0.01 * turn for turn in turns)
