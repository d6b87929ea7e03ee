"""Offsets of a laser from its configured mounting, by scans of which some were found in a wrong place."""

import math
from collections.abc import Sequence

import numpy as np

from service.estimator.motion import Measurement, Prediction
from service.geometry.se2 import SE2
from service.mapper.checks.mounting_check import BATCH_SCANS, MountingCheck

SIGMA = np.diag([0.004, 0.004, math.radians(0.2)])
TURNED = SE2(0.0, 0.0, math.pi / 2.0)
ROOM = np.eye(3)
SEARCHED_M = 1.0  # farther off a scan is not found; the first one is looked for everywhere
OPEN = np.diag([0.0, 1.0, 1.0])  # a corridor: nothing is known along it


def compare(
    offsets: list[SE2], seen: Sequence[np.ndarray] | None = None, step_m: float = 0.2
) -> MountingCheck:
    """What scans make of a mounting, each with an offset, with noise of SIGMA in the directions that it sees
    (all of them where none are given), and step_m farther than the one before.
    """
    rng = np.random.default_rng(3)
    check = MountingCheck()
    check.begin()
    for number, offset in enumerate(offsets):
        pose = SE2(1.0 + number * step_m, 2.0, 0.3)
        here = Prediction(pose, (1.0, 0.0, 0.2), SIGMA, SIGMA, np.zeros((3, 3)), 0.1, 0.0, True)
        looked_for = check.where_to_look(here, 0.0)
        off = (looked_for.pose_odom_base.inverse() @ here.pose_odom_base @ offset).log()
        directions = ROOM if seen is None else seen[number]
        if number > 0 and math.hypot(off[0], off[1]) > SEARCHED_M:
            directions = np.zeros((3, 3))
        information = directions @ np.linalg.inv(SIGMA @ SIGMA)
        covariance = np.linalg.inv(information + np.linalg.inv(looked_for.local_covariance))
        found = covariance @ information @ (off + SIGMA @ rng.standard_normal(3))
        pose = looked_for.pose_odom_base @ SE2.exp(*found.tolist())
        check.add(looked_for, Measurement(pose, covariance, information))
    return check


def test_a_scan_found_turned_by_90_degrees_does_not_accuse_a_right_mounting():
    offsets = [SE2()] * BATCH_SCANS
    offsets[5] = offsets[14] = TURNED
    check = compare(offsets)
    assert (check.is_right, check.fault) == (True, "")


def test_a_corridor_that_looks_the_same_ahead_and_behind_decides_nothing():
    check = compare([SE2()] * BATCH_SCANS, [OPEN] * BATCH_SCANS)
    assert (check.is_right, check.fault) == (False, "")


def test_one_scan_that_fixes_what_the_others_leave_open_decides_nothing():
    scans = 10 * BATCH_SCANS
    check = compare([SE2()] * scans, [ROOM] + [OPEN] * (scans - 1))
    assert (check.is_right, check.fault) == (False, "")


def test_one_scan_that_was_found_along_a_corridor_does_not_move_the_search_there():
    batch = [SE2(3.0)] + [SE2()] * (BATCH_SCANS - 1)
    check = compare([*batch, *batch[1:], SE2()], [ROOM] + [OPEN] * (BATCH_SCANS - 1) + [ROOM] * BATCH_SCANS)
    assert (check.is_right, check.fault) == (True, "")


def test_a_mounting_that_is_off_is_measured_beside_such_scans():
    offsets = [SE2(0.1, -0.05, math.radians(5.0))] * BATCH_SCANS
    offsets[3] = TURNED
    check = compare(offsets)
    assert not check.is_right
    assert check.fault.startswith(
        "is off its configured mounting by +5.0 deg, +0.10 m ahead and -0.05 m left"
    )


def test_scans_of_a_vehicle_at_rest_decide_nothing():
    check = compare([SE2()] * 10 * BATCH_SCANS, step_m=0.0)
    assert (check.is_right, check.fault) == (False, "")


def test_a_wrong_heading_is_measured_at_rest():
    check = compare([SE2(0.0, 0.0, math.radians(5.0))] * BATCH_SCANS, step_m=0.0)
    assert check.fault.startswith("is off its configured mounting by +5.0 deg")


def test_a_laser_that_is_mounted_turned_by_90_degrees_is_said_to_be():
    assert compare([TURNED] * BATCH_SCANS).fault.startswith("is off its configured mounting by +90.0 deg")


def test_scans_that_fit_nowhere_around_are_a_fault_too():
    check = compare([])
    for _ in range(BATCH_SCANS):
        assert not check.fault
        check.miss()
    assert check.fault.startswith("does not fit the map of the other lasers")
