import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.kernels import velocity_lm
from service.kernels.likelihood import read_field
from service.kernels.likelihood_lm import likelihood_normal_equations
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


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-5, 0.3, -2.0, 3.1])
def test_the_velocity_leads_from_one_pose_to_the_next(turn: float) -> None:  # A28 A30
    start = SE2(1.0, -2.0, 0.7)
    twist = (1.2, 0.1, turn / 0.02)
    end = start @ SE2.exp(*(0.02 * rate for rate in twist))
    found = np.empty(3)
    velocity_between(np.array(start), np.array(end), 0.02, found)
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
