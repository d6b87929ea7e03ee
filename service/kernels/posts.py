"""A quick look at a scan: whether it can see posts mostly."""

import math

from service.kernels.compiled import kernel

SLACK = 1e-9  # relative, for sums in another order


@kernel
def may_see_posts_mostly(xy, beam, gap, sensor_xy, step_rad, most_width_m, least_step_m, least_share):
    """Whether points in narrow runs are at least `least_share` of all. Never False where they are.

    A run ends where a return is missing or the range steps. Cut too often, its pieces are narrow all the
    more, so rounding can only make this True.

    xy             (N, 2) float64   m, in order of the beams
    beam           (N,)   int32     which beam of the scan
    gap            int              beams from one return to the next, see usual_gap
    sensor_xy      (2,)   float64   m, the sensor in the frame of xy
    step_rad       float            from one return to the next
    most_width_m   float            of a narrow run
    least_step_m   float            of the range, where a run ends
    least_share    float            0 to 1
    """
    narrow = 0
    in_run = 0
    sum_m = last_m = 0.0
    last_beam = -gap
    for i in range(xy.shape[0]):
        range_m = math.hypot(xy[i, 0] - sensor_xy[0], xy[i, 1] - sensor_xy[1])
        is_break = beam[i] - last_beam > gap or abs(range_m - last_m) > least_step_m * (1.0 - SLACK)
        if is_break and in_run > 0:
            if step_rad * sum_m <= most_width_m * (1.0 + SLACK):
                narrow += in_run
            in_run = 0
            sum_m = 0.0
        in_run += 1
        sum_m += range_m
        last_m, last_beam = range_m, beam[i]
    if step_rad * sum_m <= most_width_m * (1.0 + SLACK):
        narrow += in_run
    return narrow >= least_share * xy.shape[0]
