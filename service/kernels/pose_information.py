"""Information matrices of a pose in the plane: (3, 3) over x, y, theta."""

import math

import numpy as np

from service.kernels.arrays import Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.linear3 import solve_3x3


@inner_kernel
def wrap(theta):
    """The angle in [-pi, pi)."""
    return (theta + math.pi) % (2.0 * math.pi) - math.pi


@inner_kernel
def invert_3x3(A, inverse):
    """Inverse of a symmetric positive definite matrix; False, with `inverse` undefined, where it is not.

    A, inverse   (3, 3) float64
    """
    unit = np.zeros(3)
    column = np.empty(3)
    for k in range(3):
        unit[:] = 0.0
        unit[k] = 1.0
        if not solve_3x3(A, unit, column):
            return False
        for i in range(3):
            inverse[i, k] = column[i]
    return True


@kernel(Float64_2D, float, Float64_2D)
def rotate_information(information, theta, rotated):
    """Rotate the information of (x, y, theta) to axes against which the old ones are rotated by theta.

    information, rotated   (3, 3) float64
    theta                  float
    """
    c = math.cos(theta)
    s = math.sin(theta)
    R = np.zeros((3, 3))
    R[0, 0] = c
    R[0, 1] = -s
    R[1, 0] = s
    R[1, 1] = c
    R[2, 2] = 1.0
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(3):
                for m in range(3):
                    total += R[i, k] * information[k, m] * R[j, m]
            rotated[i, j] = total


@inner_kernel
def add_prior(pose, prior_pose, information, H, g):
    """Add the prior to the normal equations; returns its cost.

    pose, prior_pose   (3,)   float64
    information        (3, 3) float64   in the axes of the grid
    H, g               (3, 3), (3,) float64   in and out: Hessian, and gradient of half the cost
    """
    e = np.empty(3)
    e[0] = pose[0] - prior_pose[0]
    e[1] = pose[1] - prior_pose[1]
    e[2] = wrap(pose[2] - prior_pose[2])
    cost = 0.0
    for i in range(3):
        total = 0.0
        for j in range(3):
            total += information[i, j] * e[j]
            H[i, j] += information[i, j]
        g[i] += total
        cost += e[i] * total
    return cost


@inner_kernel
def weakest_direction(H):
    """The direction in which a Hessian over x, y, theta fixes the position least.

    H   (3, 3) float64
    Returns (information in 1/m^2, theta marginalised; direction in rad).
    """
    k = 1.0 / H[2, 2] if H[2, 2] > 0.0 else 0.0
    a = H[0, 0] - k * H[0, 2] * H[0, 2]
    b = H[0, 1] - k * H[0, 2] * H[1, 2]
    d = H[1, 1] - k * H[1, 2] * H[1, 2]
    half = 0.5 * (a - d)
    root = math.sqrt(half * half + b * b)
    return 0.5 * (a + d) - root, 0.5 * math.atan2(2.0 * b, a - d) + 0.5 * math.pi
