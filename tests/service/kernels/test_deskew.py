import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.kernels.deskew import Returns, deskew_points, project_returns


@pytest.mark.parametrize("turn_rate", [0.0, 1e-5, 0.8, -3.0])
def test_known_motion_is_taken_out_to_a_nanometre(turn_rate: float) -> None:
    rng = np.random.default_rng(1)
    twist = (1.2, -0.3, turn_rate)
    walls = rng.uniform(-20.0, 20.0, (200, 2))  # in the base frame of beam 0
    time_s = np.linspace(0.0, 0.1, 200)
    seen = np.empty_like(walls)
    for i, (x, y) in enumerate(walls):
        base = SE2.exp(*(rate * time_s[i] for rate in twist))
        point = base.inverse() @ SE2(x, y, 0.0)
        seen[i] = point.x_m, point.y_m
    deskewed = np.empty_like(walls)
    deskew_points(seen, time_s, np.array(twist), deskewed)
    np.testing.assert_allclose(deskewed, walls, atol=1e-9)
    assert np.abs(seen - walls).max() > 0.1  # there was something to take out


def test_returns_keep_their_beam_and_its_moment() -> None:
    range_m = np.array([np.nan, 2.0, 0.01, 60.0, 3.0], np.float32)
    range_m.setflags(write=False)
    direction = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]])
    returns = Returns(np.empty((5, 2)), np.empty(5), np.empty(5, np.int32))
    sensor, gate_m, no_outline = np.array([0.2, 0.1]), np.array([0.1, 50.0]), np.zeros((0, 2))
    count, noise_m, gap = project_returns(range_m, direction, sensor, gate_m, no_outline, 0.001, 0.0, returns)
    assert (count, noise_m, gap) == (2, 0.0, 3)
    np.testing.assert_allclose(returns.xy_raw[:2], [[0.2, 2.1], [-2.8, 0.1]])
    np.testing.assert_allclose(returns.beam_time_s[:2], [0.001, 0.004])
    assert returns.beam[:2].tolist() == [1, 4]
