"""Offset between two bases that measured the same steps, by robust least squares; see fit_step_offset."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel

MIN_TURN_RAD = 0.1  # of a step that shows the position of the laser: smaller rotations are heading noise
# Noise of a step by scan matching; by odometry, per root metre and per radian. The excess is estimated.
MATCH_M, ODOMETRY_M = 0.01, 0.02
WEAK_PRIOR_INFORMATION = 1e-6  # keeps unobservable directions invertible
ROBUST_CHI2 = 9.0  # at which a step, or a scan, has half its weight
REWEIGHTINGS = 4


@kernel(Float64_2D, Float64_1D, Float64_1D, Float64_2D)
def fit_step_offset(steps, excess, unknown, covariance):
    """Solve s o = E b - (R - I) t for E and t over the scale s, by Student's distribution.

    b and o are the translations of a step by scan matching and by odometry, R its rotation. Along and across
    the step odometry errs differently: stamps that are off by some time err along it alone.

    steps        (K, 6) float64   x, y m and theta rad by scan matching, then by odometry
    excess       (2,)   float64   in: least factors on the assumed variance of a step, along and across it;
                                  out: those estimated
    unknown      (4,)   float64   out: cosine and sine of the yaw of E, and t m; all over s
    covariance   (4, 4) float64   out
    Sources: Censi et al. 2013, as in service/mapper/checks/odometry_mounting.py; Lange, Little, Taylor:
    Robust statistical modeling using the t distribution, JASA 84, 1989 (weights and scale by iteration).
    """
    count = steps.shape[0]
    rows = np.empty((count, 2, 4))
    target = np.zeros((count, 2))
    variance = np.empty(count)
    for k in range(count):
        x, y, turn = steps[k, 0], steps[k, 1], steps[k, 2]
        turned = turn if abs(turn) >= MIN_TURN_RAD else 0.0
        c = math.cos(turned)
        s = math.sin(turned)
        target[k, 0] = math.hypot(steps[k, 3], steps[k, 4])
        along = math.atan2(steps[k, 4], steps[k, 3])
        u = math.cos(along)
        v = math.sin(along)
        fill_rotated(rows[k, :, 0], u, v, x, y)
        fill_rotated(rows[k, :, 1], u, v, -y, x)
        fill_rotated(rows[k, :, 2], u, v, 1.0 - c, -s)
        fill_rotated(rows[k, :, 3], u, v, s, 1.0 - c)
        variance[k] = MATCH_M**2 + ODOMETRY_M**2 * target[k, 0] + (ODOMETRY_M * turn) ** 2
    least = excess.copy()
    chi2 = np.zeros((count, 2))
    gradient = np.empty(4)
    for _ in range(REWEIGHTINGS):
        covariance[:] = 0.0
        gradient[:] = 0.0
        for k in range(count):
            for axis in range(2):
                weight = 1.0 / (variance[k] * (excess[axis] + chi2[k, axis] / ROBUST_CHI2))
                for i in range(4):
                    weighed = weight * rows[k, axis, i]
                    gradient[i] += weighed * target[k, axis]
                    for j in range(4):
                        covariance[i, j] += weighed * rows[k, axis, j]
        for i in range(4):
            covariance[i, i] += WEAK_PRIOR_INFORMATION
        invert_in_place(covariance)
        for i in range(4):
            unknown[i] = 0.0
            for j in range(4):
                unknown[i] += covariance[i, j] * gradient[j]
        for axis in range(2):
            total = 0.0
            for k in range(count):
                off = -target[k, axis]
                for i in range(4):
                    off += rows[k, axis, i] * unknown[i]
                chi2[k, axis] = off * off / variance[k]
                total += (ROBUST_CHI2 + 1.0) * chi2[k, axis] / (ROBUST_CHI2 + chi2[k, axis] / excess[axis])
            excess[axis] = max(total / max(count - 2, 1), least[axis])  # two unknowns for each axis


@inner_kernel
def fill_rotated(axes, u, v, x, y):
    """Components (2,) of a vector (x, y) along and across a direction (u, v)."""
    axes[0] = u * x + v * y
    axes[1] = u * y - v * x


@inner_kernel
def invert_in_place(matrix):
    """Invert a symmetric positive definite matrix by Gauss-Jordan elimination.

    matrix   (N, N) float64   in and out
    """
    size = matrix.shape[0]
    for k in range(size):
        pivot = matrix[k, k]
        matrix[k, k] = 1.0
        for j in range(size):
            matrix[k, j] /= pivot
        for i in range(size):
            if i == k:
                continue
            factor = matrix[i, k]
            matrix[i, k] = 0.0
            for j in range(size):
                matrix[i, j] -= factor * matrix[k, j]
