import math

import numpy as np
import pytest

from service.estimator.motion import Measurement, Motion
from service.geometry.se2 import SE2
from service.mapper.papers.owolm_eskf.inertial_motion import InertialMotion, InertialMotionConfig
from tests.service.estimator.samples import MS, odometry

STEP_MS, STEP_M = 100, 0.05
DOTS = np.diag([1e-4, 1e-4, 1e-6])
IN_A_ROOM = np.linalg.inv(DOTS)
IN_A_CORRIDOR = np.diag([1e-4, 1e4, 1e6])  # walls say nothing of x


def driven(model: InertialMotion, scans: range, seen_x_m, information) -> list[Motion]:
    """By wheels that say 0.5 m/s; seen_x_m: of the number of a scan, where it lies on the map."""
    motions = []
    for k in scans:
        model.add(odometry(STEP_MS * k, SE2(STEP_M * k, 0.0, 0.0)))
        model.predict(STEP_MS * k * MS)
        measured = Measurement(SE2(seen_x_m(k), 0.0, 0.0), DOTS, information, is_joined=False)
        motions.append(model.correct(measured))
    return motions


@pytest.fixture
def begun() -> InertialMotion:
    """1 m through a room."""
    model = InertialMotion(InertialMotionConfig())
    driven(model, range(21), lambda k: STEP_M * k, IN_A_ROOM)
    return model


def sigma_x_m(motion: Motion) -> float:
    return math.sqrt(motion.covariance[0, 0])


def test_walls_in_sight_again_fix_the_pose_and_dots_are_asked_again(begun: InertialMotion) -> None:
    driven(begun, range(21, 61), lambda k: 1.0, IN_A_CORRIDOR)
    motions = driven(begun, range(61, 81), lambda k: STEP_M * k, IN_A_ROOM)
    assert motions[-1].pose_odom_base.x_m == pytest.approx(4.0, abs=0.02)
    agreed = driven(begun, range(81, 121), lambda k: 4.0 + 0.97 * STEP_M * (k - 80), IN_A_CORRIDOR)
    assert agreed[-1].pose_odom_base.x_m == pytest.approx(4.0 + 0.97 * 2.0, abs=0.02)


@pytest.mark.parametrize("seen_m", [0.0, 1.0])
def test_behind_a_stretch_that_wheels_alone_measured_the_map_is_known_no_better_than_that(
    begun: InertialMotion, seen_m: float
) -> None:
    """Where dots agree with the wheels, two have measured it."""
    driven(begun, range(21, 121), lambda k: 1.0 + seen_m * STEP_M * (k - 20), IN_A_CORRIDOR)
    motions = driven(begun, range(121, 141), lambda k: STEP_M * k, IN_A_ROOM)
    if seen_m == 0.0:
        assert 0.15 < sigma_x_m(motions[-1]) < 0.4
    else:
        assert sigma_x_m(motions[-1]) < 0.02


def test_a_stretch_that_no_one_measured_is_reported_from_then_on() -> None:
    model = InertialMotion(InertialMotionConfig())
    for k in range(41):
        model.predict(STEP_MS * k * MS)
        information = IN_A_CORRIDOR if 20 < k <= 30 else IN_A_ROOM
        model.correct(Measurement(SE2(), DOTS, information, is_joined=False))
        assert model.fault == "" or k > 20
    assert "neither IMU nor odometry measured the motion over 1.0 s" in model.fault
