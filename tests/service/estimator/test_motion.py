"""Predictions across scans that were not matched."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimator.motion import OdometryIncrement, Prediction
from service.geometry.se2 import SE2

STEP = OdometryIncrement(SE2(0.1, 0.0, 0.2), 1e-4, 1e-5)


def predicted(elapsed_s: float = 0.1, increment: OdometryIncrement | None = STEP) -> Prediction:
    no = np.eye(3)
    return Prediction(SE2(), (1.0, 0.0, 2.0), no, no, no, elapsed_s, 0.1, True, increment=increment)


def test_two_steps_are_one_over_the_time_of_both() -> None:
    both = replace(predicted(), pause_s=0.5).after(
        replace(predicted(), pause_s=5.0, is_unconfirmed_stop=True)
    )
    assert (both.elapsed_s, both.travel_m, both.pause_s) == pytest.approx((0.2, 0.2, 5.0))
    assert both.is_unconfirmed_stop
    assert both.increment is not None
    assert both.increment.pose == pytest.approx(STEP.pose @ STEP.pose)
    # the heading's error of the first step moves the end of the second
    assert both.increment[1:] == pytest.approx((2e-4 + 1e-5 * 0.1**2, 2e-5, 0.0, 0.0))


def test_a_step_without_odometry_continues_by_the_twist_where_most_of_the_time_is_measured() -> None:
    both = predicted(0.02, None).after(predicted())
    assert both.increment is not None
    assert both.increment.pose == pytest.approx(STEP.pose @ SE2.exp(0.02, 0.0, 0.04))
    assert predicted().after(predicted(0.5, None)).increment is None
