"""Linear algebra for three unknowns x, y, theta: np.linalg and array copies take seconds to compile each."""

import math

import numpy as np

from service.kernels.compiled import inner_kernel


@inner_kernel
def cholesky_3x3(A, L):
    """Lower Cholesky factor of a symmetric 3 x 3 matrix.

    A  (3, 3) float64   symmetric; the lower triangle is read
    L  (3, 3) float64   out: lower factor; the upper triangle is unchanged
    Returns False where A is not positive definite; L is then undefined.
    """
    for j in range(3):
        d = A[j, j]
        for k in range(j):
            d -= L[j, k] * L[j, k]
        if not d > 0.0:  # also rejects NaN
            return False
        L[j, j] = math.sqrt(d)
        for i in range(j + 1, 3):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            L[i, j] = s / L[j, j]
    return True


@inner_kernel
def solve_3x3(A, b, x):
    """Solve A x = b for a symmetric positive definite A.

    A  (3, 3) float64
    b  (3,)   float64
    x  (3,)   float64   out
    Returns False, with x unchanged, where A is not positive definite.
    """
    L = np.zeros((3, 3))
    if not cholesky_3x3(A, L):
        return False
    y = np.empty(3)
    for i in range(3):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * y[k]
        y[i] = s / L[i, i]
    for i in range(2, -1, -1):
        s = y[i]
        for k in range(i + 1, 3):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return True


@inner_kernel
def copy_vector(source, out):
    """Copy source to out, (N,) float64; the shape check of out[:] = source takes seconds to compile."""
    for i in range(source.shape[0]):
        out[i] = source[i]


@inner_kernel
def copy_matrix(source, out):
    """Copy source to out, (N, M) float64; see copy_vector."""
    for i in range(source.shape[0]):
        for k in range(source.shape[1]):
            out[i, k] = source[i, k]


@inner_kernel
def fill_symmetric(A, xx, xy, yy, xt, yt, tt):
    """Fill A (3, 3) float64, over x, y, theta, from its entries on and above the diagonal."""
    A[0, 0] = xx
    A[0, 1] = A[1, 0] = xy
    A[1, 1] = yy
    A[0, 2] = A[2, 0] = xt
    A[1, 2] = A[2, 1] = yt
    A[2, 2] = tt


@inner_kernel
def diagonalise_3x3(A, V):
    """Eigenvalues and eigenvectors of a symmetric 3 x 3 matrix, by Jacobi rotations.

    A  (3, 3) float64   in and out: diagonal, the eigenvalues
    V  (3, 3) float64   out: the eigenvectors, a column each
    Source: Golub and Van Loan, Matrix Computations, 2013, section 8.5.
    """
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(6):  # converges quadratically: six sweeps reach the last bit
        for p in range(2):
            for q in range(p + 1, 3):
                if A[p, q] == 0.0:
                    continue
                tau = 0.5 * (A[q, q] - A[p, p]) / A[p, q]
                t = math.copysign(1.0, tau) / (abs(tau) + math.sqrt(1.0 + tau * tau))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for k in range(3):
                    left, right = A[k, p], A[k, q]
                    A[k, p] = c * left - s * right
                    A[k, q] = s * left + c * right
                for k in range(3):
                    left, right = A[p, k], A[q, k]
                    A[p, k] = c * left - s * right
                    A[q, k] = s * left + c * right
                for k in range(3):
                    left, right = V[k, p], V[k, q]
                    V[k, p] = c * left - s * right
                    V[k, q] = s * left + c * right
