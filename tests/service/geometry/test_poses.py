import numpy as np

from service.geometry import poses as se2
from service.geometry.se2 import SE2

RNG = np.random.default_rng(5)
A = RNG.uniform(-3.0, 3.0, (50, 3))
B = RNG.uniform(-3.0, 3.0, (50, 3))
A[0], B[0] = (1.0, 2.0, 1e-6), (0.0, 0.0, 0.0)


def rows(poses: list[SE2]) -> np.ndarray:
    return np.array([(p.x_m, p.y_m, p.theta_rad) for p in poses])


def test_rows_do_what_one_pose_does():
    a, b = [SE2(*row) for row in A], [SE2(*row) for row in B]
    np.testing.assert_allclose(
        se2.compose(A, B), rows([p @ q for p, q in zip(a, b, strict=True)]), atol=1e-12
    )
    apart = [p.inverse() @ q for p, q in zip(a, b, strict=True)]
    np.testing.assert_allclose(se2.between(A, B), rows(apart), atol=1e-12)
    np.testing.assert_allclose(se2.log(A), [p.log() for p in a], atol=1e-12)


def test_points_go_there_and_back():
    xy = RNG.uniform(-3.0, 3.0, (50, 2))
    out = se2.points_from(A, xy)
    turned = [SE2(*pose) @ SE2(*point, 0.0) for pose, point in zip(A, xy, strict=True)]
    np.testing.assert_allclose(out, rows(turned)[:, :2], atol=1e-12)
    np.testing.assert_allclose(se2.points_seen(A, out), xy, atol=1e-12)
    np.testing.assert_allclose(se2.points_from(A[3], xy)[7], se2.points_from(A[3], xy[7]))


def test_the_adjoint_takes_a_small_error_at_the_far_end_to_the_near_one():
    small = 1e-6 * RNG.uniform(-1.0, 1.0, (50, 3))
    there = rows([SE2(*pose) @ SE2.exp(*error) for pose, error in zip(A, small, strict=True)])
    moved = (se2.adjoint(A) @ small[..., None])[..., 0]
    here = rows([SE2.exp(*error) @ SE2(*pose) for pose, error in zip(A, moved, strict=True)])
    np.testing.assert_allclose(here, there, atol=1e-10)
