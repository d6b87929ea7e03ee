"""A fast test whether a scan can consist mostly of posts."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D
from service.kernels.compiled import inner_kernel, kernel

SLACK = 1e-9  # relative, for sums in a different order


@inner_kernel
def missing_by_chance(range_m, beam, gap, least_step_m):
    """Longest run of missing returns expected by chance in a scan; 0 where no return is missing.

    The probability of a missing return is counted between returns of the same surface.

    range_m        (N,) float64   m
    beam           (N,) int32     index of the beam in the scan
    gap            int            beams from one return to the next
    least_step_m   float          range step between two surfaces
    """
    present = missing = 0
    for i in range(1, range_m.shape[0]):
        if abs(range_m[i] - range_m[i - 1]) <= least_step_m:
            present += beam[i] - beam[i - 1] == gap
            missing += beam[i] - beam[i - 1] == 2 * gap
    if missing == 0:
        return 0
    probability = missing / (missing + present)
    # N p^n, the expected number of runs of n, is above a half up to this n.
    return int(math.log(2.0 * range_m.shape[0]) / -math.log(probability)) if present > 0 else range_m.shape[0]


@kernel(Float64_2D, Int32_1D, int, Float64_1D, float, float, float, float)
def may_be_posts(xy, beam, gap, sensor_xy, step_rad, most_width_m, least_step_m, least_share):
    """Whether points in narrow runs are at least `least_share` of all; and the longest chance gap.

    A run ends where more returns are missing than chance explains, or where the range steps. Rounding can
    only split runs, which makes them narrower: the result may be falsely True, never falsely False.

    xy             (N, 2) float64   m, in order of the beams
    beam           (N,)   int32     index of the beam in the scan
    gap            int              beams from one return to the next, see usual_gap
    sensor_xy      (2,)   float64   m, the sensor in the frame of xy
    step_rad       float            from one return to the next
    most_width_m   float            of a narrow run
    least_step_m   float            range step at which a run ends
    least_share    float            0 to 1
    """
    count = xy.shape[0]
    range_m = np.empty(count)
    for i in range(count):
        range_m[i] = math.hypot(xy[i, 0] - sensor_xy[0], xy[i, 1] - sensor_xy[1])
    most_missing = missing_by_chance(range_m, beam, gap, least_step_m)
    narrow = begin = 0
    sum_m = 0.0
    for i in range(count + 1):
        is_end = i == count
        if i > 0 and not is_end:
            is_end = beam[i] - beam[i - 1] > gap * (most_missing + 1)
            is_end = is_end or abs(range_m[i] - range_m[i - 1]) > least_step_m * (1.0 - SLACK)
        if is_end:
            steps = (beam[i - 1] - beam[begin]) / gap + 1.0
            if steps * step_rad * sum_m <= most_width_m * (i - begin) * (1.0 + SLACK):
                narrow += i - begin
            begin = i
            sum_m = 0.0
        if i < count:
            sum_m += range_m[i]
    return narrow >= least_share * count, most_missing
