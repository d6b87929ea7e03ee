"""Posts of a scan: narrow runs of neighbouring returns with a farther background on both sides."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D
from service.kernels.compiled import inner_kernel, kernel

# Share of the points on posts: 0.73 and more in a wood. With fewer posts, walls fix the pose better.
MIN_POST_SHARE = 0.7


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


@kernel(Float64_2D, Int32_1D, int, int, float, Float64_1D, float, float)
def find_posts(xy, beam, gap, beam_count, step_rad, sensor_xy, least_step_m, most_width_m):
    """Runs of neighbouring points that are seen completely: with a farther background on both sides.

    A run ends where more returns are missing than chance explains, or where the range steps.

    xy             (N, 2) float64   m, in order of the beams; N > 0
    beam           (N,)   int32     index of the beam in the scan
    gap            int              beams from one return to the next, see usual_gap
    beam_count     int              of the scan
    step_rad       float            from one return to the next
    sensor_xy      (2,)   float64   m, the sensor in the frame of xy
    least_step_m   float            range step at which a run ends
    most_width_m   float            of a run
    Returns (first point of each such run and the one after its last, (M, 2) int64; spacing of its points,
    (M,) m; number of points in all of them).
    """
    count = xy.shape[0]
    range_m = np.empty(count)
    for i in range(count):
        range_m[i] = math.hypot(xy[i, 0] - sensor_xy[0], xy[i, 1] - sensor_xy[1])
    most_apart = gap * (missing_by_chance(range_m, beam, gap, least_step_m) + 1)
    span = np.empty((count, 2), np.int64)
    spacing_m = np.empty(count)
    found = points = begin = 0
    before = True  # the background beside the run's first point is farther away, or nothing is in range
    total_m = 0.0
    for i in range(count):
        total_m += range_m[i]
        apart = i + 1 == count or beam[i + 1] - beam[i] > most_apart
        step_m = math.inf if apart else range_m[i + 1] - range_m[i]
        if abs(step_m) <= least_step_m:
            continue
        end = i + 1
        spacing = step_rad * (total_m / (end - begin))
        width_m = ((beam[i] - beam[begin]) / gap + 1.0) * spacing
        is_inside = beam[begin] >= gap and beam[i] < beam_count - gap
        if width_m <= most_width_m and before and step_m > 0.0 and is_inside:
            span[found, 0], span[found, 1] = begin, end
            spacing_m[found] = spacing
            found += 1
            points += end - begin
        before = apart or step_m < 0.0
        begin = end
        total_m = 0.0
    return span[:found], spacing_m[:found], points
