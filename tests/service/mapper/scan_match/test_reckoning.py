"""The path by odometry against the matched one."""

from dataclasses import replace

import numpy as np
import pytest

from service.estimator.motion import OdometryIncrement
from service.geometry.se2 import SE2
from service.mapper.scan_match.reckoning import Reckoning
from tests.service.mapper.maps.points import prediction

STEP_NS, STEPS = 20_000_000, 10


@pytest.mark.parametrize(("end_m2", "is_conflict"), [(0.0, True), (0.015**2, True), (0.05**2, False)])
def test_an_extrapolated_end_widens_a_path_once(end_m2: float, is_conflict: bool) -> None:
    """0.2 m by odometry, 0.1 m by the matches: 18 sigmas; 4.6 or 1.4 of both ends of the path."""
    reckoning, usual = Reckoning(), prediction(SE2(), 1e-4 * np.eye(3))
    for k in range(STEPS + 1):
        step = OdometryIncrement(SE2(0.02), 1e-8, 1e-8, end_m2, 0.0)
        seen = replace(usual, increment=step, elapsed_s=0.02)
        conflict = reckoning.add(k * STEP_NS, seen, SE2(0.01 * k))
    assert (conflict is not None) is is_conflict
