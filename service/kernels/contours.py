"""Contours: neighbouring end points of a scan joined to lines."""

import math

import numpy as np

from service.kernels.arrays import Float64_2D, Int32_1D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.ordering import order_rising

ALONE = -1
SHORTEST_STEP_M = 1e-6  # lower bound, so that coincident points have a ratio


@kernel(Float64_2D, float, float, Int32_1D)
def extract_contours(xy_base, longest_m, most_ratio, contour):
    """Grow contours from the closest pairs, at both ends, while steps are short and similar.

    xy_base      (N, 2) float64   end points in beam order, m
    longest_m    float            longest step of a contour
    most_ratio   float            largest ratio of neighbouring steps
    contour      (N,)   int32     out: number of the contour of each point, in the order they were found;
                                  ALONE where it belongs to none. The points of a contour are consecutive.
    Returns the number of contours.
    Source: Li et al. 2016, section 2.2, eq. 5. A seed is a pair of free points; a new step is compared with
    the last one of its end.
    """
    count = xy_base.shape[0]
    contour.fill(ALONE)
    if count < 2:
        return 0
    step_m = np.empty(count - 1)  # from point k to point k + 1
    for k in range(count - 1):
        dx = xy_base[k + 1, 0] - xy_base[k, 0]
        dy = xy_base[k + 1, 1] - xy_base[k, 1]
        step_m[k] = max(math.sqrt(dx * dx + dy * dy), SHORTEST_STEP_M)
    found = 0
    order = np.empty(count - 1, np.int64)
    order_rising(step_m, order)
    for k in order:
        if step_m[k] > longest_m:
            break
        if contour[k] != ALONE or contour[k + 1] != ALONE:
            continue
        contour[k] = found
        contour[k + 1] = found
        at = k + 1
        while at + 1 < count and contour[at + 1] == ALONE:
            if not _may_continue(step_m[at], step_m[at - 1], longest_m, most_ratio):
                break
            at += 1
            contour[at] = found
        at = k
        while at > 0 and contour[at - 1] == ALONE:
            if not _may_continue(step_m[at - 1], step_m[at], longest_m, most_ratio):
                break
            at -= 1
            contour[at] = found
        found += 1
    return found


@inner_kernel
def _may_continue(step_m, last_m, longest_m, most_ratio):
    """Whether a step may follow the last one of a contour; eq. 5."""
    return step_m <= longest_m and max(step_m, last_m) <= most_ratio * min(step_m, last_m)
