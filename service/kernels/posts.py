"""Runs of neighbouring returns of one surface, among which posts are searched."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D
from service.kernels.compiled import inner_kernel, kernel


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


@kernel(Float64_2D, Int32_1D, int, Float64_1D, float)
def runs_of(xy, beam, gap, sensor_xy, least_step_m):
    """Runs of neighbouring points: a run ends where more returns are missing than chance explains, or where
    the range steps.

    xy             (N, 2) float64   m, in order of the beams; N > 0
    beam           (N,)   int32     index of the beam in the scan
    gap            int              beams from one return to the next, see usual_gap
    sensor_xy      (2,)   float64   m, the sensor in the frame of xy
    least_step_m   float            range step at which a run ends
    Returns (range of each point (N,) float64, m; first point of each run and N (R + 1,) int64; whether
    returns are missing before each run (R,) bool).
    """
    count = xy.shape[0]
    range_m = np.empty(count)
    for i in range(count):
        range_m[i] = math.hypot(xy[i, 0] - sensor_xy[0], xy[i, 1] - sensor_xy[1])
    most_apart = gap * (missing_by_chance(range_m, beam, gap, least_step_m) + 1)
    first = np.empty(count + 1, np.int64)
    is_apart = np.empty(count, np.bool_)
    runs = 0
    for i in range(count):
        apart = i > 0 and beam[i] - beam[i - 1] > most_apart
        if i == 0 or apart or abs(range_m[i] - range_m[i - 1]) > least_step_m:
            first[runs] = i
            is_apart[runs] = apart
            runs += 1
    first[runs] = count
    return range_m, first[: runs + 1], is_apart[:runs]
