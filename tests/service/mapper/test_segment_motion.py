"""A detached segment that may move with the vehicle: whether the motion on it counts as measured."""

import math
from dataclasses import replace

import numpy as np
import pytest

from service.estimator.motion import OdometryIncrement, Prediction
from service.geometry.se2 import SE2
from service.mapper.judgement import MAX_SIGMA_M, MAX_UNMEASURED_S, UNKNOWN_SIGMA_M
from service.mapper.segment_motion import SegmentMotion

STEP_NS, STEP_S, SPEED_MPS = 40_000_000, 0.04, 1.0
NO = np.eye(3)
ODOMETRY = OdometryIncrement(SE2(SPEED_MPS * STEP_S), 1e-6, 1e-6)


def prediction(x_m: float, increment: OdometryIncrement | None = None) -> Prediction:
    twist = (SPEED_MPS, 0.0, 0.0)
    return Prediction(
        SE2(x_m), twist, NO, NO, NO, STEP_S, 0.0, is_measured=increment is not None, increment=increment
    )


def on_segment(
    speed_mps: float, increment: OdometryIncrement | None = None, scans: int = 50
) -> list[tuple[Prediction, float]]:
    """Scans at SPEED_MPS contradict the map; on the segment that they begin the speed is speed_mps."""
    motion, seen = SegmentMotion(), []
    for k in range(scans):
        predicted, unmeasured_s = motion.predicted(
            k * STEP_NS, prediction(k * STEP_S * speed_mps, increment if k else None)
        )
        motion.matched(k * STEP_NS, predicted, is_paused=False, is_on_map=False)
        seen.append((predicted, unmeasured_s))
    return seen


def test_a_segment_on_which_the_vehicle_goes_on_stands_still() -> None:
    for predicted, unmeasured_s in on_segment(SPEED_MPS)[1:]:
        assert unmeasured_s == 0.0
        np.testing.assert_allclose(predicted.segment_covariance, 0.0, atol=1e-12)


def test_a_segment_on_which_the_vehicle_stops_at_once_may_move_with_it() -> None:
    seen = on_segment(0.0)
    since_s = [unmeasured_s for _, unmeasured_s in seen if unmeasured_s]
    assert since_s == [pytest.approx(math.ceil(MAX_SIGMA_M / SPEED_MPS / STEP_S) * STEP_S)]  # reported once
    assert seen[2][0].segment_covariance[0, 0] == pytest.approx((2 * STEP_S * SPEED_MPS) ** 2)
    assert seen[-1][0].segment_covariance[0, 0] == UNKNOWN_SIGMA_M**2


def test_odometry_measures_the_motion_on_any_segment() -> None:
    for predicted, unmeasured_s in on_segment(0.0, ODOMETRY):
        assert unmeasured_s == 0.0
        assert predicted.segment_covariance is None


def test_a_scan_on_the_map_ends_the_comparison() -> None:
    motion = SegmentMotion()
    for k, is_on_map in ((0, False), (1, True), (50, False)):
        predicted, unmeasured_s = motion.predicted(k * STEP_NS, prediction(0.0))
        motion.matched(k * STEP_NS, predicted, False, is_on_map)
        assert unmeasured_s == 0.0


def test_after_a_pause_of_all_sensors_the_segment_is_not_begun_once_more() -> None:
    motion = SegmentMotion()
    paused = replace(prediction(0.0), pause_s=MAX_UNMEASURED_S + 1.0)
    motion.matched(0, paused, is_paused=True, is_on_map=False)
    for k in range(1, 50):
        predicted, unmeasured_s = motion.predicted(k * STEP_NS, prediction(0.0))
        motion.matched(k * STEP_NS, predicted, is_paused=False, is_on_map=False)
        assert unmeasured_s == 0.0
        assert predicted.segment_covariance is None
