"""Scans that cannot be, and scans before their odometry."""

import math
from dataclasses import replace

import numpy as np

from drivers.frames import NO_INTENSITY, LaserScan
from service.estimator.motion import PAUSE_NS
from service.kernels.tracks import SPEED_WINDOW_NS
from service.mapper.checks.sensor_checks import OdometryWait, ScanCheck

S = 1_000_000_000


def scan(stamp_ns: int, arrived_ns: int, range_m: float = 1.0) -> LaserScan:
    ranges = np.full(50, range_m, np.float32)
    ranges[3] = np.nan
    return LaserScan(
        "front", stamp_ns, arrived_ns, 0, S // 10, -1.0, 0.04, 0.05, math.inf, ranges, NO_INTENSITY
    )


def test_a_beam_that_comes_back_or_stays_away_makes_another_scan() -> None:
    """No return equals no return, and nothing else; nor does a scan of fewer beams equal one of more."""
    first = scan(0, 0)
    more = replace(first, range_m=np.where(np.arange(50) == 7, np.float32(np.nan), first.range_m))
    fewer = replace(first, range_m=first.range_m[:-1])
    for one, other in ((first, more), (more, first), (first, fewer)):
        check = ScanCheck()
        check.is_repeated(one, 0.0)
        assert not check.is_repeated(other, 1.0)
        assert check.is_repeated(other, 1.0)


def test_after_a_pause_of_both_a_scan_waits_for_odometry_and_not_for_ever() -> None:
    wait = OdometryWait()
    assert not wait.waits(9 * S, 1 * S)  # no odometry is used
    for stamp_ns in (1 * S, 2 * S):
        wait.add(stamp_ns)
    assert not wait.waits(4 * S, 3 * S)
    assert not wait.waits(9 * S, 8 * S)  # odometry alone is silent
    assert wait.waits(9 * S, 4 * S)
    assert wait.waits(9 * S + PAUSE_NS, 4 * S)
    assert not wait.waits(9 * S + PAUSE_NS + 1, 4 * S)


def test_after_a_pause_of_both_the_speed_is_waited_for_too() -> None:
    wait = OdometryWait()
    wait.add(1 * S)
    wait.add(20 * S)
    assert wait.waits(20 * S + 1, 2 * S)
    wait.add(20 * S + SPEED_WINDOW_NS - 1)
    assert wait.waits(20 * S + SPEED_WINDOW_NS, 2 * S)
    wait.add(20 * S + SPEED_WINDOW_NS)
    assert not wait.waits(20 * S + SPEED_WINDOW_NS + 1, 2 * S)
    for stamp_s in (21, 22, 23, 24):
        wait.add(stamp_s * S)
    assert not wait.waits(25 * S, 21 * S)  # the laser alone was silent
    assert wait.waits(40 * S, 25 * S)  # the next pause of both
