import math

import numpy as np
import pytest

from service.kernels.normals import estimate_normals
from service.kernels.range_bias import bias_at, see_bias, shorten_ranges
from service.kernels.surfels import insert_surfels
from tests.service.kernels.surfel_grids import empty_grid
from tests.service.kernels.test_match import SETTINGS, SIGMA_M, STEP_RAD

NODE_M, NODES = 0.5, 12
ANGLES = np.arange(-2.8, 2.8, STEP_RAD)


def test_the_curve_is_linear_between_its_nodes_and_goes_on_as_it_ends() -> None:
    curve_m = np.array([0.0, 0.01, 0.03])
    assert bias_at(curve_m, 0.5, 0.25) == pytest.approx(0.005)
    assert bias_at(curve_m, 0.5, 0.75) == pytest.approx(0.02)
    assert bias_at(curve_m, 0.5, 9.0) == pytest.approx(0.03)


def test_points_move_along_their_beams() -> None:
    sensor = np.array([0.2, -0.1])
    xy = sensor + np.array([[1.0, 0.0], [0.0, -2.0], [0.0, 0.0]])
    shortened = np.empty_like(xy)
    shorten_ranges(xy, sensor, np.full(8, 0.03), 0.5, shortened)
    np.testing.assert_allclose(shortened - sensor, [[0.97, 0.0], [0.0, -1.97], [0.0, 0.0]], atol=1e-12)


def seen_from(x_m: float, bias_m: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A room 8 m by 2 m from a place on its middle line, with ranges too long by a curve; and its normals."""
    with np.errstate(divide="ignore"):
        to_sides = 1.0 / np.abs(np.sin(ANGLES))
        to_ends = np.where(np.cos(ANGLES) > 0.0, 4.0 - x_m, 4.0 + x_m) / np.abs(np.cos(ANGLES))
    range_m = np.minimum(to_sides, to_ends)
    range_m += np.interp(range_m, NODE_M * np.arange(NODES), bias_m) + rng.normal(0.0, SIGMA_M, len(range_m))
    xy, normals = (
        range_m[:, None] * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]),
        np.empty((len(ANGLES), 3)),
    )
    estimate_normals(xy, np.zeros(2), STEP_RAD, SIGMA_M, 5.0, normals, np.empty(len(xy)))
    return xy, normals


def test_the_bias_of_some_ranges_shows_on_walls_that_were_seen_without_it() -> None:
    """Both ends of the room were seen from all over; now those at 2.5 to 3.5 m stand 2 cm behind."""
    rng = np.random.default_rng(3)
    grid = empty_grid()
    for x_m in np.arange(-2.0, 2.01, 0.1):
        xy, normals = seen_from(x_m, np.zeros(NODES), rng)
        insert_surfels(xy, normals, np.array([x_m, 0.0, 0.0]), grid, 1000.0, 1.0)
    bias_m = np.zeros(NODES)
    bias_m[5:8] = 0.02
    total, weighted = 1e4 * np.eye(NODES), np.zeros(NODES)
    for x_m in np.arange(-1.5, 1.51, 0.1):
        xy, normals = seen_from(x_m, bias_m, rng)
        one, of_one = np.empty((NODES, NODES)), np.empty(NODES)
        see_bias(xy, normals, np.array([x_m, 0.0, 0.0]), np.zeros(2), grid, SETTINGS, NODE_M, one, of_one)
        np.testing.assert_allclose(one, one.T, atol=1e-6 * np.abs(one).max())
        assert np.linalg.eigvalsh(one)[0] > -1e-6 * np.abs(one).max()
        total, weighted = total + one, weighted + of_one
    seen_m = np.linalg.solve(total, weighted)
    np.testing.assert_allclose(seen_m[5:8], 0.02, atol=0.004)
    np.testing.assert_allclose(seen_m[2:4], 0.0, atol=0.004)
    assert math.isfinite(seen_m.sum())
