import math

import numpy as np
import pytest

from service.geometry.se2 import SE2, wrap_angle


def matrix(pose: SE2) -> np.ndarray:
    c, s = math.cos(pose.theta_rad), math.sin(pose.theta_rad)
    return np.array([[c, -s, pose.x_m], [s, c, pose.y_m], [0.0, 0.0, 1.0]])


def random_poses() -> list[SE2]:
    rng = np.random.default_rng(1)
    return [SE2(*rng.uniform(-5.0, 5.0, 2), wrap_angle(rng.uniform(-9.0, 9.0))) for _ in range(20)]


def test_composition_is_the_product_of_matrices() -> None:
    for a, b in zip(random_poses(), reversed(random_poses()), strict=True):
        np.testing.assert_allclose(matrix(a @ b), matrix(a) @ matrix(b), atol=1e-12)


def test_a_pose_and_its_inverse_cancel() -> None:
    for pose in random_poses():
        np.testing.assert_allclose(matrix(pose @ pose.inverse()), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("turn_rad", [0.0, 1e-9, 1e-6, 1e-3, 1.0, -3.0])
def test_log_undoes_exp(turn_rad: float) -> None:
    assert SE2.exp(0.7, -0.2, turn_rad).log() == pytest.approx((0.7, -0.2, turn_rad), abs=1e-12)


def test_exp_is_many_small_steps() -> None:
    pose = SE2()
    for _ in range(20_000):
        pose = pose @ SE2(3.5e-5, -1e-5, 6.5e-5)
    whole = SE2.exp(0.7, -0.2, 1.3)
    assert (pose.x_m, pose.y_m, pose.theta_rad) == pytest.approx(
        (whole.x_m, whole.y_m, whole.theta_rad), abs=5e-5
    )


def test_angles_are_wrapped_with_pi_kept_and_minus_pi_not() -> None:
    assert wrap_angle(math.pi) == math.pi
    assert wrap_angle(-math.pi) == math.pi
    assert wrap_angle(7.0) == pytest.approx(7.0 - 2.0 * math.pi)
    many = np.array([math.pi, -math.pi, 7.0, -9.0, 0.0, 1e6])
    assert wrap_angle(many).tolist() == [wrap_angle(one) for one in many.tolist()]
