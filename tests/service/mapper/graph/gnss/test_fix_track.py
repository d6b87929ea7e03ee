"""Fixes along the path: the fault of a bad one is named, a good one gets the pose of its moment."""

import math
from dataclasses import replace

import pytest

from drivers.frames import GnssFix
from service.geometry.se2 import SE2
from service.mapper.graph.gnss.fix_track import FixTrack

GOOD = GnssFix("imu", 150_000_000, 0, 0, 60.161, 24.546, 51.7, (4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0))
NAN = math.nan


def test_a_fix_lies_between_the_scans_of_its_moment_whichever_came_first():
    for fix_first in (True, False):
        track = FixTrack()
        if fix_first:
            assert track.add_fix(GOOD, (0.5, 0.1)) == "fixes_taken"
        track.add_scan(100_000_000, SE2(1.0, 2.0, 0.0), 7)
        assert track.take() == []
        track.add_scan(200_000_000, SE2(1.0, 2.0, 0.0) @ SE2.exp(0.4, 0.0, 0.2), 8)
        if not fix_first:
            assert track.add_fix(GOOD, (0.5, 0.1)) == "fixes_taken"
        (placed,) = track.take()
        expected = SE2(1.0, 2.0, 0.0) @ SE2.exp(0.2, 0.0, 0.1)
        assert placed.pose_odom_base.x_m == pytest.approx(expected.x_m)
        assert placed.pose_odom_base.theta_rad == pytest.approx(0.1)
        assert placed.keyframe == 7
        assert placed.antenna_xy_m == (0.5, 0.1)
        assert placed.covariance == (4.0, 0.0, 4.0)
        assert track.take() == []


def test_a_fix_without_height_is_taken_at_the_height_of_the_one_before():
    track = FixTrack()
    for k, altitude_m in enumerate((NAN, 51.7, NAN)):
        fix = replace(GOOD, stamp_ns=k * 10**9, latitude_deg=60.161 + k * 1e-4, altitude_m=altitude_m)
        assert track.add_fix(fix, (0.0, 0.0)) == "fixes_taken"
        track.add_scan(k * 10**9, SE2(11.0 * k, 0.0, 0.0), k)
    assert [placed.height_m for placed in track.take()] == [0.0, 51.7, 51.7]
    assert track.take_counts()["fixes_without_height"] == 2


@pytest.mark.parametrize(
    ("change", "counter"),
    [
        ({"status": -1}, "fixes_without_position"),
        ({"latitude_deg": NAN}, "fixes_without_position"),
        ({"latitude_deg": 91.0}, "fixes_impossible"),
        ({"longitude_deg": -181.0}, "fixes_impossible"),
        ({"altitude_m": math.inf}, "fixes_impossible"),
        ({"covariance": (0.0,) * 9}, "fixes_without_covariance"),
        ({"covariance": (NAN,) * 9}, "fixes_without_covariance"),
        ({"covariance": (4.0, 0, 0, 0, -1.0, 0, 0, 0, 1)}, "fixes_without_covariance"),
        ({"covariance": (4.0, 4.0, 0, 4.0, 4.0, 0, 0, 0, 1)}, "fixes_without_covariance"),
        ({"covariance": (4.0, 0, 0, 0, math.inf, 0, 0, 0, 1)}, "fixes_without_covariance"),
        ({"covariance": (4.0, 0, 0, 0, 121.0, 0, 0, 0, 1)}, "fixes_too_poor"),
        ({"covariance": (70.0, 60.0, 0, 60.0, 70.0, 0, 0, 0, 1)}, "fixes_too_poor"),  # 11.4 m north-east
    ],
)
def test_the_fault_of_a_fix_is_named(change, counter):
    track = FixTrack()
    assert track.add_fix(replace(GOOD, **change), (0.0, 0.0)) == counter
    track.add_scan(0, SE2(), 0)
    track.add_scan(10**9, SE2(), 0)
    assert track.take() == []


@pytest.mark.parametrize(
    "scans",
    [
        [(0, 0), (1_100_000_000, 1)],  # a scan gap
        [(160_000_000, 0), (200_000_000, 0)],  # the drive began later
        [(100_000_000, -1), (200_000_000, -1)],  # no key frame yet
    ],
)
def test_a_fix_in_a_scan_gap_is_counted(scans):
    track = FixTrack()
    track.add_fix(GOOD, (0.0, 0.0))
    for stamp_ns, keyframe in scans:
        track.add_scan(stamp_ns, SE2(), keyframe)
    assert track.take() == []
    assert track.take_counts() == {"fixes_without_scans": 1}
    assert track.take_counts() == {}


def test_a_receiver_that_repeats_its_position_while_the_vehicle_moves_is_named():
    track = FixTrack()
    kept = []
    for k in range(400):
        track.add_scan(k * 10**8, SE2(0.1 * k, 0.0, 0.0), k)
        latitude_deg = 60.0 + 1e-6 * (k if not 100 <= k < 300 else 100)
        track.add_fix(replace(GOOD, stamp_ns=k * 10**8, latitude_deg=latitude_deg), (0.0, 0.0))
        kept += [placed.keyframe for placed in track.take()]
    assert track.take_counts()["fixes_frozen"] == 189  # from 1.0 m after the last that was new
    assert kept == [0, 50, 100, 300, 350]


def test_a_fix_as_old_as_the_one_before_and_one_of_another_receiver_are_named():
    track = FixTrack()
    assert track.add_fix(GOOD, (0.0, 0.0)) == "fixes_taken"
    assert track.add_fix(GOOD, (0.0, 0.0)) == "fixes_out_of_order"
    assert track.add_fix(replace(GOOD, sensor="roof"), (0.0, 0.0)) == "fixes_of_another_receiver"
