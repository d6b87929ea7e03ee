import math

import numpy as np
import pytest

from service.kernels import pose_information
from service.kernels.pose_information import rotate_information
from tests.service.kernels.inner import from_python

add_prior = from_python(pose_information.add_prior)
invert_3x3 = from_python(pose_information.invert_3x3)
weakest_direction = from_python(pose_information.weakest_direction)


def test_the_prior_is_a_parabola_around_its_pose() -> None:
    root = np.random.default_rng(1).normal(size=(3, 3))
    information, centre = root @ root.T, np.array([1.0, 2.0, 3.1])
    matrix, gradient = np.zeros((3, 3)), np.zeros(3)
    pose = np.array([1.2, 1.9, 3.1 + 0.1 - 2.0 * math.pi])  # a full turn away
    cost = add_prior(pose, centre, information, matrix, gradient)
    e = np.array([0.2, -0.1, 0.1])
    assert cost == pytest.approx(e @ information @ e)
    np.testing.assert_allclose(matrix, information)
    np.testing.assert_allclose(gradient, information @ e)


def test_information_turns_with_its_axes() -> None:
    turned = np.empty((3, 3))
    rotate_information(np.diag([1.0, 9.0, 4.0]), math.pi / 2.0, turned)
    np.testing.assert_allclose(turned, np.diag([9.0, 1.0, 4.0]), atol=1e-12)


def test_an_inverse_agrees_with_numpy() -> None:
    a, inverse = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]]), np.empty((3, 3))
    assert invert_3x3(a, inverse)
    np.testing.assert_allclose(inverse, np.linalg.inv(a), rtol=1e-12)


def test_the_weakest_direction_is_that_along_a_corridor() -> None:
    towards = math.radians(30.0)
    across = np.array([-math.sin(towards), math.cos(towards)])
    along = np.array([math.cos(towards), math.sin(towards)])
    information = np.zeros((3, 3))
    information[:2, :2] = 1e4 * np.outer(across, across) + 25.0 * np.outer(along, along)
    information[2, 2] = 1e5
    least, direction = weakest_direction(information)
    assert least == pytest.approx(25.0)
    assert direction % math.pi == pytest.approx(towards)
