import numpy as np
import pytest

from service.kernels import range_bias
from tests.service.kernels.inner import from_python

bias_at = from_python(range_bias.bias_at)
subtract_bias = from_python(range_bias.subtract_bias)


def test_the_curve_is_linear_between_its_nodes_and_goes_on_as_it_ends() -> None:
    curve_m = np.array([0.0, 0.01, 0.03])
    assert bias_at(curve_m, 0.25) == pytest.approx(0.005)
    assert bias_at(curve_m, 0.75) == pytest.approx(0.02)
    assert bias_at(curve_m, 9.0) == pytest.approx(0.03)


def test_points_move_along_their_beams() -> None:
    sensor = np.array([0.2, -0.1])
    xy = sensor + np.array([[1.0, 0.0], [0.0, -2.0], [0.0, 0.0]])
    shortened = np.empty_like(xy)
    subtract_bias(xy, sensor, np.full(8, 0.03), shortened)
    np.testing.assert_allclose(shortened - sensor, [[0.97, 0.0], [0.0, -1.97], [0.0, 0.0]], atol=1e-12)
