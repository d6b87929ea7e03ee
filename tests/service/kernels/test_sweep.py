"""How much of a measured deviation within a sweep is motion."""

import pytest

from service.kernels import sweep
from tests.service.kernels.inner import from_python

gain_of = from_python(sweep.gain_of)


def test_within_the_gate_it_is_what_the_model_expects_of_it() -> None:
    assert gain_of(3.0, 1.0, 1.0) == pytest.approx(0.75)
    assert gain_of(0.0, 1.0, 1.0) == 0.0


def test_what_no_motion_explains_loses_weight_by_its_size() -> None:
    """As of a gyro in degrees for radians: 57 times too much bends a scan by less than the truth."""
    kept = [gain_of(3.0, measured, 1.0) * measured for measured in (5.0, 50.0, 500.0)]
    assert kept[0] > 3.5
    assert kept[1] == pytest.approx(kept[2] * 10.0)
    assert kept[1] < 0.5
