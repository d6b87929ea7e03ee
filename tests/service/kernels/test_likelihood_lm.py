import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.kernels import velocity_lm
from service.kernels.likelihood import read_field
from service.kernels.likelihood_lm import LmSettings, align_points, likelihood_normal_equations, thin_evenly
from service.kernels.robust_normals import balance_weights, estimate_orientations
from tests.service.kernels.inner import from_python
from tests.service.kernels.test_likelihood import field_of, random_field

velocity_between = from_python(velocity_lm.velocity_between)


def test_the_gradient_is_that_of_finite_differences() -> None:  # A22
    noise = np.random.default_rng(4)
    grid = random_field()
    xy, weights = noise.uniform(-2.0, 2.0, (40, 2)), 4.0 * noise.random(40)
    values, hessian, g = np.empty((40, 3)), np.empty((3, 3)), np.empty(3)

    def cost(pose: np.ndarray) -> float:
        read_field(xy, pose, field_of(grid), values)
        return likelihood_normal_equations(xy, values, weights, pose, hessian, g)

    pose = np.array([0.11, -0.07, 0.3])
    cost(pose)
    gradient = g.copy()
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-8
        slope = (cost(pose + step) - cost(pose - step)) / 2e-8
        assert slope == pytest.approx(gradient[k], rel=1e-6, abs=1e-4)


def test_points_thinned_evenly_weigh_as_much_as_all() -> None:
    xy = np.arange(22.0).reshape(11, 2)
    thin, weights = thin_evenly(xy, 4, 0.5)
    np.testing.assert_array_equal(thin, xy[::2])
    np.testing.assert_array_equal(weights, np.full(6, 8.0))
    np.testing.assert_array_equal(thin_evenly(xy, 20, 0.5)[0], xy)


def test_a_descent_step_by_step_is_that_in_one_go() -> None:
    xy, field = np.random.default_rng(6).uniform(-2.0, 2.0, (60, 2)), field_of(random_field())
    weights, prior = np.full(60, 4.0), 50.0 * np.eye(3)
    start, settings = np.array([0.11, -0.07, 0.3]), LmSettings(100)
    at_once, single, hessian = start.copy(), start.copy(), np.empty((3, 3))
    steps, is_settled, _ = align_points(
        xy, weights, start, prior, field, settings, 50, 1e-3, at_once, hessian
    )
    assert steps > 3
    assert is_settled
    damping = settings.first_damping
    for _ in range(steps):
        _, is_settled, damping = align_points(
            xy, weights, start, prior, field, settings, 1, damping, single, hessian
        )
    assert is_settled
    np.testing.assert_array_equal(single, at_once)


def test_a_descent_solves_no_more_systems_than_it_may() -> None:
    xy, field = np.random.default_rng(6).uniform(-2.0, 2.0, (60, 2)), field_of(random_field())
    weights, no_prior, pose, hessian = np.full(60, 4.0), np.zeros((3, 3)), np.zeros(3), np.empty((3, 3))
    settings = LmSettings(0)
    assert align_points(xy, weights, pose, no_prior, field, settings, 5, 1e-3, pose, hessian)[0] == 0
    np.testing.assert_array_equal(pose, 0.0)
    assert hessian[0, 0] > 0.0


@pytest.mark.parametrize("floor", [0.0, 1e-9])
def test_a_direction_that_nothing_fixes_needs_a_floor_or_a_prior(floor: float) -> None:
    """A field that rises along x alone, read at one point ahead."""
    grid = random_field()
    rising = np.arange(grid.field.shape[2], dtype=np.float32) / grid.field.shape[2]
    grid.field[:] = 0.5 * rising
    pose, hessian = np.array([0.3, 0.35, 0.0]), np.empty((3, 3))
    settings = LmSettings(20, floor=floor)
    steps, _, _ = align_points(
        np.zeros((1, 2)),
        np.ones(1),
        np.zeros(3),
        np.zeros((3, 3)),
        field_of(grid),
        settings,
        1,
        1e-3,
        pose,
        hessian,
    )
    assert steps == (1 if floor else 0)
    assert pose[1] == 0.35
    assert (pose[0] > 0.3) == bool(floor)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-5, 0.3, -2.0, 3.1])
def test_the_velocity_leads_from_one_pose_to_the_next(turn: float) -> None:  # A28 A30
    start = SE2(1.0, -2.0, 0.7)
    twist = (1.2, 0.1, turn / 0.02)
    end = start @ SE2.exp(*(0.02 * rate for rate in twist))
    found = np.empty(3)
    velocity_between(
        np.array(start),
        np.array(end),
        0.02,
        found,
    )
    np.testing.assert_allclose(found, twist, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("outliers", "most_deg"), [(0.0, 3.0), (0.3, 5.0)])
def test_normals_of_a_noisy_wall(outliers: float, most_deg: float) -> None:  # A23
    off = []
    for seed in range(5):
        noise = np.random.default_rng(seed)
        y = np.arange(-1.0, 1.0, 0.05)
        x = 3.0 + 0.012 * noise.standard_normal(len(y))
        bad = noise.random(len(y)) < outliers
        x[bad] += noise.uniform(0.3, 1.5, bad.sum())
        angle = np.empty(len(y))
        estimate_orientations(np.column_stack([x, y]), np.zeros(2), math.radians(0.5), 10, 0.5, 0.02, angle)
        off += list(np.degrees(np.abs((angle[10:-10][~bad[10:-10]] + np.pi / 2) % np.pi - np.pi / 2)))
    assert np.median(off) < most_deg


def test_the_few_end_points_of_a_corridor_count() -> None:  # A24 A25
    angle = np.concatenate([np.full(486, 1.57), np.full(54, 0.01), [np.nan]])
    histogram, weight = np.empty(12, np.int64), np.empty(541)
    balance_weights(angle, 100.0, 50.0, histogram, weight)
    assert list(histogram[[0, 5]]) == [54, 486]
    sides, end = weight[:486].sum(), weight[486:540].sum()
    assert end / sides == pytest.approx(
        (1 + math.exp((100 - 486) / 50)) / (1 + math.exp((100 - 54) / 50)), rel=1e-9
    )
    assert weight[540] == 0.0
    assert weight.mean() == pytest.approx(1.0)
