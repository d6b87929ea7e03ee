import numpy as np
import pytest

from service.kernels import range_bias
from service.kernels.range_bias import subtract_bias
from tests.service.kernels.inner import from_python

bias_at = from_python(range_bias.bias_at)


def test_the_curve_is_linear_between_its_nodes_and_goes_on_as_it_ends() -> None:
    curve_m = np.array([0.0, 0.01, 0.03])
    assert bias_at(curve_m, 0.5, 0.25) == pytest.approx(0.005)
    assert bias_at(curve_m, 0.5, 0.75) == pytest.approx(0.02)
    assert bias_at(curve_m, 0.5, 9.0) == pytest.approx(0.03)


def test_points_move_along_their_beams() -> None:
    sensor = np.array([0.2, -0.1])
    xy = sensor + np.array([[1.0, 0.0], [0.0, -2.0], [0.0, 0.0]])
    raw, base = np.empty_like(xy), np.empty_like(xy)
    subtract_bias(xy, xy[::-1].copy(), sensor, np.full(8, 0.03), 0.5, raw, base)
    np.testing.assert_allclose(raw - sensor, [[0.97, 0.0], [0.0, -1.97], [0.0, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(base, raw[::-1])
