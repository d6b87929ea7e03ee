"""The judge of a run, on evidence made by hand: a vehicle that drives along x at 1 m/s."""

from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from tests.chaos.drive import Interval, Up
from tests.chaos.judge import DEVICES, Evidence, Expected, Figures, judge, worst

TENTH_NS, SECOND_NS = 10**8, 10**9
SECONDS = 10
UP = Up(0, SECONDS * SECOND_NS, False, 0)
CAUSE = Interval(4 * SECOND_NS, 5 * SECOND_NS)
STAMPS_NS = range(0, UP.until_ns, TENTH_NS)
TRUTH = np.array([(stamp_ns, 3.0 + stamp_ns / SECOND_NS, 2.0, 0.0) for stamp_ns in (*STAMPS_NS, UP.until_ns)])


def evidence(number: int = 0) -> Evidence:
    """Of a run in which nothing happened. Its map begins at the vehicle, the world elsewhere."""
    found = Evidence()
    for name, period_s in DEVICES.items():
        stamps_ns = np.arange(0, UP.until_ns, round(period_s * SECOND_NS)).tolist()
        found.stamps[name], found.arrivals[name] = list(stamps_ns), list(stamps_ns)
    found.arrivals["pose"] = found.logged = list(STAMPS_NS)
    found.poses = [(number, stamp_ns, SE2(stamp_ns / SECOND_NS, 0.0, 0.0)) for stamp_ns in STAMPS_NS]
    found.states = [(at_ns, "ok") for at_ns in range(0, UP.until_ns, SECOND_NS)]
    return found


def figures(found: Evidence) -> Figures:
    return judge(found, TRUTH, CAUSE, [UP])


def test_a_run_without_a_fault_has_no_error_and_loses_nothing():
    seen = figures(evidence())
    assert seen == Figures(0.02, "front/scan", 0, 0.1, 0.0, 0.0, 0, ("ok",), (0,))
    assert Expected().missed_by(seen) == []


@pytest.mark.parametrize(("state", "wrong_ok"), [("ok", 10), ("degraded", 0)])
def test_poses_that_are_off_count_where_the_state_in_force_is_ok(state: str, wrong_ok: int):
    found = evidence()
    found.states[6] = (6 * SECOND_NS, state)
    found.poses = [
        (number, stamp_ns, pose @ SE2(0.0, 0.4, 0.0) if 6 <= stamp_ns / SECOND_NS < 7 else pose)
        for number, stamp_ns, pose in found.poses
    ]
    seen = figures(found)
    assert seen.wrong_ok == wrong_ok
    assert seen.rmse_m == pytest.approx(0.4 * np.sqrt(10 / 100), abs=1e-3)
    assert any("state ok" in words for words in Expected().missed_by(seen)) == (wrong_ok > 0)


def test_each_map_begins_where_its_first_pose_says():
    found = evidence()
    shift = SE2(-5.0, 1.0, 0.0)  # of a second map, which begins elsewhere
    found.poses = [
        (int(k >= 50), stamp_ns, shift @ pose if k >= 50 else pose)
        for k, (_, stamp_ns, pose) in enumerate(found.poses)
    ]
    assert figures(found).rmse_m == 0.0
    found.poses = [(0, stamp_ns, pose) for _, stamp_ns, pose in found.poses]
    assert figures(found).rmse_m > 1.0


def test_recovery_ends_with_the_device_that_comes_last_and_its_frames_are_counted_as_lost():
    found = evidence()
    away = Interval(CAUSE.from_ns, CAUSE.until_ns + 3 * SECOND_NS // 2)
    for kept in (found.stamps, found.arrivals):
        kept["lux/scan"] = [t for t in kept["lux/scan"] if not away.from_ns <= t < away.until_ns]
    seen = figures(found)
    assert (seen.recovery_s, seen.last) == (1.52, "lux/scan")  # the first scan after it
    assert seen.frames_lost == 63  # 2.5 s at 25 Hz
    found.arrivals["lux/scan"] = [t for t in found.arrivals["lux/scan"] if t < away.from_ns]
    assert Expected().missed_by(figures(found)) == ["recovery_s inf, at most 2 expected"]


def test_data_are_lost_from_the_last_message_to_the_end_of_the_service():
    found = evidence()
    found.logged = [at_ns for at_ns in found.logged if at_ns < 8 * SECOND_NS]
    assert figures(found).data_lost_s == 2.1
    assert judge(found, TRUTH, CAUSE, [UP._replace(until_ns=8 * SECOND_NS)]).data_lost_s == 0.1


def test_exit_codes_and_damaged_files_are_not_as_expected_and_the_worst_of_runs_is_kept():
    good = figures(evidence())
    bad = replace(good, recovery_s=3.0, last="imu/imu", codes=(1,), damaged=("a.mcap: cut off",), wrong_ok=2)
    both = worst([good, bad, good])
    assert (both.recovery_s, both.last, both.codes, both.wrong_ok) == (3.0, "imu/imu", (0, 1, 0), 2)
    assert len(Expected().missed_by(both)) == 4
