"""Covariance of a pose where only scans measure the motion, and walls do not fix the position along them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from service.estimator.estimator import Estimator, EstimatorConfig
from service.estimator.motion import Measurement
from service.geometry.se2 import SE2
from simulators.trajectory import Follow, Limits, Pause, plan_drive
from simulators.world import Plan, World, make_world
from tests.accuracy.driving import mapping_config, ok_and_wrong
from tests.service.estimator.samples import MS, odometry
from tests.simulated import LMS100_50HZ, drive, run
from tests.soaked import in_soak

FOLLOWED = np.diag([0.01**2, 0.005**2, 0.001**2])  # of the pose, by the full information of a scan
ACROSS = np.diag([0.0, 1.0 / 0.005**2, 1.0 / 0.001**2])  # less chance: none along the walls


def drive_on(model: Estimator, from_ms: int, until_ms: int, has_odometry: bool = False) -> np.ndarray:
    """(2,) m: sigma along and across of the pose, after 1 m/s along featureless walls."""
    covariance = np.zeros((3, 3))
    for stamp_ms in range(from_ms, until_ms + 1, 20):
        if has_odometry:
            assert model.add(odometry(stamp_ms, SE2(stamp_ms * 1e-3, 0.0, 0.0)))
        model.predict(stamp_ms * MS)
        found = model.correct(Measurement(SE2(stamp_ms * 1e-3, 0.0, 0.0), FOLLOWED, ACROSS))
        model.settle(0.99)
        covariance = found.covariance
    assert np.allclose(covariance, model.moved(0.0).covariance)
    return np.sqrt(np.diag(covariance)[:2])


def test_a_motion_that_no_one_measured_is_not_known() -> None:
    model = Estimator(EstimatorConfig())
    along_m, across_m = drive_on(model, 0, 1000)
    assert along_m > 0.05
    assert across_m < 0.02
    along_m, across_m = drive_on(model, 1020, 4000)
    assert along_m > 0.5
    assert across_m < 0.04


def test_odometry_that_comes_back_does_not_tell_where_the_pose_is() -> None:
    model = Estimator(EstimatorConfig())
    drive_on(model, 0, 4000)
    along_m, _ = drive_on(model, 4020, 6000, has_odometry=True)  # it measures speed
    with_odometry_m, _ = drive_on(Estimator(EstimatorConfig()), 0, 6000, has_odometry=True)
    assert along_m > 1.0 > 0.2 > with_odometry_m


def corridor() -> World:
    """A corridor of 40 m whose only doors, sunk by 25 cm, lie near its ends."""
    plan = Plan()
    plan.sunk_doors((0, -1), (40, -1), [2.0, 33.0], depth=-0.25)
    plan.sunk_doors((0, 1), (40, 1), [1.5, 34.0], depth=0.25)
    plan.line((0, -1), (0, 1))
    plan.line((40, -1), (40, 1))
    lane = plan_drive(SE2(1.5, 0.0, 0.0), [Follow([(38.5, 0.0)]), Pause(1.0)], Limits(speed_mps=1.5))
    return make_world("corridor", plan, [], lane)


@pytest.mark.parametrize("seed", [1, in_soak(2)])
def test_the_covariance_of_a_laser_alone_grows_along_a_corridor(seed: int) -> None:
    """It ends metres off, at doors that it cannot have mapped before: `ok` is no pose from there on."""
    world = corridor()
    laser = replace(LMS100_50HZ, rate_hz=12.5)
    made = drive(world, laser, world.drive.duration_s, seed, wheels=None)
    done = run(mapping_config(), made)
    off_m = np.hypot(done.errors[:, 0], done.errors[:, 1])
    assert off_m[-1] > 1.0, "the drive is of no use for this test"
    assert done.outputs[-1].state == "degraded"
    assert "uncertain by" in done.outputs[-1].reason
    assert ok_and_wrong(done) == 0
    sigma_m = math.sqrt(np.linalg.eigvalsh(done.outputs[-1].covariance[:2, :2])[-1])
    assert sigma_m > 1.0
