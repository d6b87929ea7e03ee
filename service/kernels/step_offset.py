"""Offset between two bases that measured the same steps, by robust least squares; see fit_step_offset."""

import math

import numpy as np

from service.geometry.chi2 import CHI2_MEDIAN_OF_2
from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.ordering import kth_smallest

MIN_TURN_RAD = 0.1  # of a step that shows the position of the laser: smaller rotations are heading noise
# Noise of a step by scan matching; by odometry, per root metre and per radian. The excess is estimated.
MATCH_M, ODOMETRY_M = 0.01, 0.02
WEAK_PRIOR_INFORMATION = 1e-6  # keeps unobservable directions invertible
ROBUST_CHI2 = 9.0  # at which a step, or a scan, has half its weight
REWEIGHTINGS = 4


@kernel(Float64_2D, float, Float64_1D, Float64_2D)
def fit_step_offset(steps, min_excess, unknown, covariance):
    """Solve s o = E b - (R - I) t for E and t over the scale s, by iterated weights.

    b and o are the translations of a step by scan matching and by odometry, R its rotation.

    steps        (K, 6) float64   x, y m and theta rad by scan matching, then by odometry
    min_excess   float            least factor on the assumed variance of a step
    unknown      (4,)   float64   out: cosine and sine of the yaw of E, and t m; all over s
    covariance   (4, 4) float64   out
    Returns the factor on the assumed variance, by the median of the residuals.
    Source: Censi et al. 2013, as in service/mapper/checks/odometry_mounting.py.
    """
    count = steps.shape[0]
    rows = np.empty((count, 2, 4))
    variance = np.empty(count)
    chi2 = np.zeros(count)
    ordered = np.empty(count)
    for k in range(count):
        x, y, turn = steps[k, 0], steps[k, 1], steps[k, 2]
        turned = turn if abs(turn) >= MIN_TURN_RAD else 0.0
        c = math.cos(turned)
        s = math.sin(turned)
        rows[k, 0, 0], rows[k, 0, 1], rows[k, 0, 2], rows[k, 0, 3] = x, -y, 1.0 - c, s
        rows[k, 1, 0], rows[k, 1, 1], rows[k, 1, 2], rows[k, 1, 3] = y, x, -s, 1.0 - c
        path_length_m = math.hypot(steps[k, 3], steps[k, 4])
        variance[k] = MATCH_M**2 + ODOMETRY_M**2 * path_length_m + (ODOMETRY_M * turn) ** 2
    excess = min_excess
    gradient = np.empty(4)
    for _ in range(REWEIGHTINGS):
        covariance[:] = 0.0
        gradient[:] = 0.0
        for k in range(count):
            weight = 1.0 / (variance[k] * excess * (1.0 + chi2[k] / (ROBUST_CHI2 * excess)))
            for axis in range(2):
                for i in range(4):
                    weighed = weight * rows[k, axis, i]
                    gradient[i] += weighed * steps[k, 3 + axis]
                    for j in range(4):
                        covariance[i, j] += weighed * rows[k, axis, j]
        for i in range(4):
            covariance[i, i] += WEAK_PRIOR_INFORMATION
        invert_in_place(covariance)
        for i in range(4):
            unknown[i] = 0.0
            for j in range(4):
                unknown[i] += covariance[i, j] * gradient[j]
        for k in range(count):
            chi2[k] = 0.0
            for axis in range(2):
                off = -steps[k, 3 + axis]
                for i in range(4):
                    off += rows[k, axis, i] * unknown[i]
                chi2[k] += off * off / variance[k]
            ordered[k] = chi2[k]
        median = 0.5 * (
            kth_smallest(ordered, count, (count - 1) // 2) + kth_smallest(ordered, count, count // 2)
        )
        excess = max(median / CHI2_MEDIAN_OF_2, min_excess)
    return excess


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
