"""Offsets of a laser from its configured mounting, by scans of which some were found in a wrong place."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from service.estimator.motion import Measurement, Prediction
from service.geometry.se2 import SE2
from service.mapper.checks.mounting_check import SEARCHED, MountingCheck, centre
from service.mapper.checks.stamp_check import BATCH

SIGMA = np.diag([0.004, 0.004, math.radians(0.2)])
TURNED = SE2(0.0, 0.0, math.pi / 2.0)
OPEN = np.diag([0.0, 1.0, 1.0])  # a corridor: nothing is known along it
CHANCE = np.diag([1e-6, 1e-6, 1e-4])  # by chance inliers: sigmas of 4 m and 20 deg
HERE = Prediction(SE2(1.0, 2.0, 0.3), (1.0, 0.0, 0.2), SIGMA, SIGMA, np.zeros((3, 3)), 0.1, 0.0, True)


def compare(
    offsets: list[SE2], seen: np.ndarray | None = None, advantages: Sequence[float | None] = (None,)
) -> MountingCheck:
    """What the scans at these offsets make of a mounting, each with noise of SIGMA in the directions seen.

    advantages   of the batches in turn, the last of all that follow
    """
    seen, rng = np.eye(3) if seen is None else seen, np.random.default_rng(3)
    check = MountingCheck()
    check.begin()
    for number, offset in enumerate(offsets):
        prior = check.search_prior(HERE, 0.0)
        advantage = advantages[min(number // BATCH, len(advantages) - 1)]
        check.add(prior, measured(prior, offset, seen, rng), advantage)
    return check


def measured(prior: Prediction, offset: SE2, seen: np.ndarray, rng: np.random.Generator) -> Measurement:
    """A scan at this offset from HERE."""
    off = (prior.pose_odom_base.inverse() @ HERE.pose_odom_base @ offset).log()
    information = seen @ np.linalg.inv(SIGMA @ SIGMA)
    covariance = np.linalg.inv(information + np.linalg.inv(prior.local_covariance))
    found = covariance @ information @ (off + SIGMA @ rng.standard_normal(3))
    pose = prior.pose_odom_base @ SE2.exp(*found.tolist())
    return Measurement(pose, covariance, information)


def refined(offset: SE2, scans: int = 1000) -> MountingCheck:
    """A mapped laser at this offset, whose scans follow those of others."""
    check, rng = MountingCheck(), np.random.default_rng(4)
    predicted = replace(HERE, local_covariance=1e-6 * np.eye(3))
    for _ in range(scans):
        check.refine(predicted, measured(predicted, check.applied.inverse() @ offset, np.eye(3), rng))
    return check


def test_scans_after_those_of_other_lasers_correct_a_mounting_measured_by_hand():
    offset = SE2(0.02, -0.01, math.radians(0.2))
    off = np.array((refined(offset).applied.inverse() @ offset).log())
    assert (np.abs(off) < np.array([0.001, 0.001, math.radians(0.05)])).all()


def test_a_calibrated_mounting_stays_as_configured():
    """Else noise would bend the map: along a corridor it agrees with any yaw."""
    assert refined(SE2(0.001, 0.0, math.radians(0.02))).applied == SE2()


@pytest.mark.parametrize("is_further", [True, False])
def test_a_further_laser_that_is_knocked_is_compared_with_the_map_again(is_further):
    check, rng = MountingCheck(), np.random.default_rng(4)
    if is_further:
        check = compare([SE2()] * BATCH)
    predicted = replace(HERE, local_covariance=1e-6 * np.eye(3))
    for _ in range(BATCH):
        check.refine(predicted, measured(predicted, SE2(0.0, 0.0, math.radians(3.0)), np.eye(3), rng))
    assert check.is_right != is_further
    assert check.applied == SE2()


def test_lasers_that_differ_are_corrected_alike():
    first, second = MountingCheck(), refined(SE2(0.02))
    centre([first, second])
    assert first.applied.x_m == pytest.approx(-0.01, abs=0.001)
    assert second.applied.x_m == pytest.approx(0.01, abs=0.001)


@pytest.mark.parametrize("seen", [np.eye(3), OPEN], ids=["room", "corridor"])
def test_a_scan_found_turned_by_90_degrees_does_not_accuse_a_right_mounting(seen):
    offsets = [SE2()] * BATCH
    offsets[5] = offsets[14] = TURNED
    check = compare(offsets, seen)
    assert (check.is_right, check.fault) == (True, "")


def test_a_mounting_that_is_off_is_measured_beside_such_scans():
    offsets = [SE2(0.1, -0.05, math.radians(5.0))] * BATCH
    offsets[3] = TURNED
    check = compare(offsets)
    assert not check.is_right
    assert check.fault.startswith(
        "is off its configured mounting by +5.0 deg, +0.10 m ahead and -0.05 m left"
    )


def test_chance_inliers_move_the_search_by_its_sigmas_at_most():
    check = compare([SE2(-3.0, 0.5, 0.2)] * BATCH, CHANCE)
    moved = HERE.pose_odom_base.inverse() @ check.search_prior(HERE, 0.0).pose_odom_base
    assert (np.abs(moved.log()) <= 1.02 * np.sqrt(np.diag(SEARCHED))).all()
    assert (check.is_right, check.fault) == (False, "")


def test_a_mounting_is_not_judged_while_ahead_and_behind_look_alike():
    check = compare([SE2()] * BATCH * 3, OPEN, [0.02])
    assert (check.is_right, check.fault) == (False, "")
    assert compare([SE2()] * BATCH * 3, OPEN, [0.02, 0.12]).is_right


def test_a_laser_that_looks_backwards_is_a_fault_that_one_batch_does_not_clear():
    for advantages in ([-0.3], [-0.3, 0.11]):
        check = compare([SE2()] * BATCH * 2, OPEN, advantages)
        assert not check.is_right
        assert check.fault.startswith("fits better if it is turned by 180 deg")


def test_scans_that_fit_nowhere_around_are_a_fault_too():
    check = compare([])
    for _ in range(BATCH):
        assert not check.fault
        check.miss()
    assert check.fault.startswith("does not fit the map of the other lasers")
