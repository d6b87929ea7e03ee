import math

import pytest

from service.geometry.se2 import SE2
from tests.papers.headings import bends

SECOND_NS = 1_000_000_000


def test_a_path_bends_by_the_sum_of_its_steps_before_and_after_a_moment() -> None:
    """0.5 deg too much a step for 10 s, then one jump of 5 deg; the true heading passes 180 deg."""
    true = {k * SECOND_NS: SE2(0.0, 0.0, math.radians(170.0 + k)) for k in range(21)}
    off_deg = [0.5 * min(k, 10) + (5.0 if k > 15 else 0.0) for k in range(21)]
    path = {k * SECOND_NS: SE2(0.0, 0.0, math.radians(170.0 + k + off_deg[k] - 360.0)) for k in range(21)}
    early, late = bends(path, true, 10.5)
    assert (early.steps, late.steps) == (10, 10)
    assert (early.sum_deg, early.rms_deg, early.jumps) == (pytest.approx(5.0), pytest.approx(0.5), 0)
    assert (late.sum_deg, late.jumps) == (pytest.approx(5.0), 1)
