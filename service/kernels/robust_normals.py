"""Robust orientation of the wall at each end point, and weights that balance orientations."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int64_1D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.ordering import kth_smallest

MAX_NEIGHBOURS = 21
CONCENTRATION_STEPS = 4
CHI2_975 = 7.378  # of two degrees of freedom; gate for outliers
CHI2_MEDIAN = 1.386  # of two degrees of freedom
MIN_VARIANCE_M2 = 1e-12  # keeps the covariance of collinear points regular


@kernel(Float64_2D, Float64_1D, float, int, float, float, Float64_1D)
def estimate_orientations(
    xy_base, sensor_xy_m, angle_step_rad, beams_each_side, half_length_m, thin_m, angle
):
    """Direction of the normal at each point, from its neighbours.

    xy_base           (N, 2) float64   end points in beam order, m, base frame
    sensor_xy_m       (2,)   float64   start of the beams
    angle_step_rad    float            between neighbouring beams, > 0
    beams_each_side   int              least neighbours on each side; near walls all within
    half_length_m     float            ... this distance, at most MAX_NEIGHBOURS in all
    thin_m            float            neighbours with less scatter across their line are used without a
                                       robust estimate
    angle             (N,)   float64   out: rad in [0, pi), base axes; NaN with fewer than 3 points
    Source: Li et al. 2016, section 2.3: robust diagnostic PCA after Nurunnabi et al., by the minimum
    covariance determinant: outliers beyond the 97.5 % quantile of the robust distance are left out, then PCA.
    """
    count = xy_base.shape[0]
    window = np.empty((MAX_NEIGHBOURS, 2))
    distance = np.empty(MAX_NEIGHBOURS)
    chosen = np.empty(MAX_NEIGHBOURS, np.bool_)
    for i in range(count):
        range_m = math.hypot(xy_base[i, 0] - sensor_xy_m[0], xy_base[i, 1] - sensor_xy_m[1])
        reach = MAX_NEIGHBOURS // 2
        wanted = half_length_m / max(angle_step_rad * range_m, 1e-9)
        if wanted < reach:
            reach = max(beams_each_side, int(wanted))
        low = max(0, i - reach)
        n = min(count, i + reach + 1) - low
        angle[i] = np.nan
        if n < 3:
            continue
        for k in range(n):
            window[k, 0] = xy_base[low + k, 0] - xy_base[i, 0]
            window[k, 1] = xy_base[low + k, 1] - xy_base[i, 1]
            chosen[k] = True
        _, _, a, b, d = moments(window, chosen, n)
        across = 0.5 * (a + d) - math.sqrt(0.25 * (a - d) * (a - d) + b * b)
        if across > thin_m * thin_m:
            concentrate(window, n, distance, chosen)
            _, _, a, b, d = moments(window, chosen, n)
        angle[i] = (0.5 * math.atan2(2.0 * b, a - d) + 0.5 * math.pi) % math.pi
        if angle[i] >= math.pi:  # a rounded-up remainder
            angle[i] = 0.0


@inner_kernel
def moments(window, chosen, n):
    """Mean and covariance (xx, xy, yy) of the chosen points."""
    size = 0
    mx = my = 0.0
    for k in range(n):
        if chosen[k]:
            size += 1
            mx += window[k, 0]
            my += window[k, 1]
    mx /= size
    my /= size
    a = b = d = 0.0
    for k in range(n):
        if chosen[k]:
            x = window[k, 0] - mx
            y = window[k, 1] - my
            a += x * x
            b += x * y
            d += y * y
    return mx, my, a / size + MIN_VARIANCE_M2, b / size, d / size + MIN_VARIANCE_M2


@inner_kernel
def concentrate(window, n, distance, chosen):
    """Choose the inliers by the subset of least covariance determinant.

    window     (M, 2) float64   m, n of them in use
    distance   (M,)   float64   scratch
    chosen     (M,)   bool      out
    Source: Rousseeuw and Van Driessen 1999; from four fixed subsets instead of random ones: three runs of
    neighbouring points, and all of them.
    """
    half = (n + 3) // 2
    sorted_in_part = np.empty(n)
    best = np.inf
    best_mx = best_my = 0.0
    best_a = best_d = 1.0
    best_b = 0.0
    for start in range(4):
        first = (n - half) * start // 2
        for k in range(n):
            chosen[k] = start == 3 or first <= k < first + half
        mx, my, a, b, d = moments(window, chosen, n)
        for _ in range(CONCENTRATION_STEPS):
            mahalanobis(window, n, mx, my, a, b, d, distance)
            for k in range(n):
                sorted_in_part[k] = distance[k]
            limit = kth_smallest(sorted_in_part, n, half - 1)
            size = 0
            for k in range(n):
                chosen[k] = distance[k] <= limit and size < half
                size += chosen[k]
            mx, my, a, b, d = moments(window, chosen, n)
        if a * d - b * b < best:
            best = a * d - b * b
            best_mx, best_my, best_a, best_b, best_d = mx, my, a, b, d
    mahalanobis(window, n, best_mx, best_my, best_a, best_b, best_d, distance)
    # scaled so that the median of inliers is that of chi-squared
    for k in range(n):
        sorted_in_part[k] = distance[k]
    scale = kth_smallest(sorted_in_part, n, half - 1) / CHI2_MEDIAN
    for k in range(n):
        chosen[k] = distance[k] <= CHI2_975 * scale


@inner_kernel
def mahalanobis(window, n, mx, my, a, b, d, distance):
    """Squared Mahalanobis distance of n points from a mean under the covariance ((a, b), (b, d))."""
    determinant = a * d - b * b
    for k in range(n):
        x = window[k, 0] - mx
        y = window[k, 1] - my
        distance[k] = (d * x * x - 2.0 * b * x * y + a * y * y) / determinant


@kernel(Float64_1D, float, float, Int64_1D, Float64_1D)
def balance_weights(angle, middle_count, slope_count, histogram, weight):
    """Weight of each point by the number of points with its orientation: small groups are suppressed, large
    ones count equally.

    angle          (N,) float64   from estimate_orientations
    middle_count   float          a group of so many counts for one half; 100 is printed
    slope_count    float          50 is printed
    histogram      (B,) int64     out: points in each of B bins of pi / B
    weight         (N,) float64   out: scaled to a mean of 1; 0 without an orientation, 1 for all where no
                                  orientation is known
    Source: Li et al. 2016, eq. 9, over 180 deg since normals have no sign.
    """
    bins = histogram.shape[0]
    histogram[:] = 0
    for i in range(angle.shape[0]):
        if not math.isnan(angle[i]):
            histogram[int(angle[i] / math.pi * bins) % bins] += 1
    total = 0.0
    for i in range(angle.shape[0]):
        weight[i] = 0.0
        if not math.isnan(angle[i]):
            n = histogram[int(angle[i] / math.pi * bins) % bins]
            weight[i] = 1.0 / (n * (1.0 + math.exp((middle_count - n) / slope_count)))
            total += weight[i]
    for i in range(angle.shape[0]):
        weight[i] = weight[i] * angle.shape[0] / total if total > 0.0 else 1.0
