import numpy as np

from service.kernels import linear3
from tests.service.kernels.inner import from_python

cholesky_3x3 = from_python(linear3.cholesky_3x3)
diagonalise_3x3 = from_python(linear3.diagonalise_3x3)
solve_3x3 = from_python(linear3.solve_3x3)


def test_solutions_agree_with_numpy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        root = rng.normal(size=(3, 3))
        a, b, x = root @ root.T + 0.1 * np.eye(3), rng.normal(size=3), np.empty(3)
        assert solve_3x3(a, b, x)
        np.testing.assert_allclose(x, np.linalg.solve(a, b), rtol=1e-9)


def test_factor_agrees_with_numpy() -> None:
    a = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.2], [0.5, 0.2, 2.0]])
    lower = np.zeros((3, 3))
    assert cholesky_3x3(a, lower)
    np.testing.assert_allclose(lower, np.linalg.cholesky(a), rtol=1e-14)


def test_a_singular_matrix_is_refused_and_leaves_the_answer_alone() -> None:
    x = np.full(3, 7.0)
    assert not solve_3x3(np.ones((3, 3)), np.ones(3), x)
    assert not solve_3x3(np.diag([1.0, -1.0, 1.0]), np.ones(3), x)
    assert not solve_3x3(np.diag([1.0, np.nan, 1.0]), np.ones(3), x)
    np.testing.assert_array_equal(x, 7.0)


def test_jacobi_finds_the_eigenvalues_that_eigh_finds() -> None:
    rng = np.random.default_rng(4)
    for scale in (1.0, 1e6):
        root = rng.normal(size=(3, 3)) * (1.0, 1.0, scale)
        matrix = root + root.T
        values, vectors = matrix.copy(), np.empty((3, 3))
        diagonalise_3x3(values, vectors)
        np.testing.assert_allclose(
            np.sort(np.diag(values)), np.linalg.eigvalsh(matrix), rtol=1e-9, atol=1e-9 * scale
        )
        np.testing.assert_allclose(vectors @ np.diag(np.diag(values)) @ vectors.T, matrix, atol=1e-9 * scale)
        np.testing.assert_allclose(vectors @ vectors.T, np.eye(3), atol=1e-12)
