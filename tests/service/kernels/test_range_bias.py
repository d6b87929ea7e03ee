import numpy as np
import pytest

from service.kernels import range_bias
from service.kernels.normals import estimate_normals
from service.kernels.range_bias import bias_information, subtract_bias
from service.kernels.surfels import LASERS, SurfelGrid, insert_surfels, shorten_surfels
from tests.service.kernels.inner import from_python
from tests.service.kernels.surfel_grids import empty_grid
from tests.service.kernels.test_match import SETTINGS, SIGMA_M, STEP_RAD

bias_at = from_python(range_bias.bias_at)

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
    subtract_bias(xy, sensor, np.full(8, 0.03), 0.5, shortened)
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
    estimate_normals(xy, np.zeros(2), STEP_RAD, SIGMA_M, 5.0, normals, np.empty((len(xy), 2)))
    return xy, normals


def mapped(bias_m: np.ndarray, rng: np.random.Generator) -> SurfelGrid:
    """The room as laser 0 has seen it from all over."""
    grid = empty_grid()
    for x_m in np.arange(-2.0, 2.01, 0.1):
        xy, normals = seen_from(x_m, bias_m, rng)
        insert_surfels(xy, normals, np.array([x_m, 0.0, 0.0]), grid, 1000.0, 1.0, np.zeros(2), 0)
    return grid


def seen_bias(grid: SurfelGrid, bias_m: np.ndarray, laser: int, rng: np.random.Generator) -> np.ndarray:
    """(NODES + 1,) as more scans of the room tell it, the bias of all ranges last."""
    total, weighted = 1e4 * np.eye(NODES + 1), np.zeros(NODES + 1)
    for x_m in np.arange(-1.5, 1.51, 0.1):
        xy, normals = seen_from(x_m, bias_m, rng)
        pose = np.array([x_m, 0.0, 0.0])
        one, of_one = np.empty((NODES + 1, NODES + 1)), np.empty(NODES + 1)
        bias_information(xy, normals, pose, np.zeros(2), laser, grid, SETTINGS, NODE_M, one, of_one)
        np.testing.assert_allclose(one, one.T, atol=1e-6 * np.abs(one).max())
        assert np.linalg.eigvalsh(one)[0] > -1e-6 * np.abs(one).max()
        total, weighted = total + one, weighted + of_one
    return np.linalg.solve(total, weighted)


def test_the_bias_of_some_ranges_shows_on_walls_that_were_seen_without_it() -> None:
    """Both ends of the room were seen from all over; now those at 2.5 to 3.5 m stand 2 cm behind."""
    rng = np.random.default_rng(3)
    bias_m = np.zeros(NODES)
    bias_m[5:8] = 0.02
    seen_m = seen_bias(mapped(np.zeros(NODES), rng), bias_m, LASERS, rng)
    np.testing.assert_allclose(seen_m[5:8], 0.02, atol=0.004)
    np.testing.assert_allclose(seen_m[2:4], 0.0, atol=0.004)
    assert seen_m[NODES] == 0.0  # of a laser too many no one knows where the map has it from


def test_the_bias_of_all_ranges_shows_in_the_angles_at_which_walls_are_seen() -> None:
    """Map and scans have it alike: a wall seen obliquely is displaced less than one seen head-on."""
    rng = np.random.default_rng(4)
    bias_m = np.full(NODES, 0.02)
    grid = mapped(bias_m, rng)
    assert seen_bias(grid, bias_m, 0, rng)[NODES] == pytest.approx(0.02, abs=0.004)
    shorten_surfels(grid, 0, 0.02)
    still_m = seen_bias(grid, np.zeros(NODES), 0, rng)[NODES]
    assert still_m == pytest.approx(0.0, abs=0.004)
