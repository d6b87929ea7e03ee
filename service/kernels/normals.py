"""Direction of the wall at each end point, from the beams beside it."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

WALL_M = 0.004  # how even a wall is, at best


class NormalSettings(NamedTuple):
    """What counts as one piece of wall; documented where it is configured."""

    beams_each_side: int
    most_beams_each_side: int
    half_length_m: float
    gap_m: float
    gap_steps: float
    planar_ratio: float
    least_cos_incidence: float
    rough_weight: float
    planar_m: float
    grazing_weight: float


@njit(cache=True, nogil=True)
def estimate_normals(xy_base, sensor_xy_m, angle_step_rad, settings, normals):
    """Principal axes of each point and its contiguous neighbours.

    xy_base          (N, 2) float64   end points in beam order, m, base frame
    sensor_xy_m      (2,)   float64   where the beams start, m, base frame
    angle_step_rad   float            between neighbouring beams, > 0
    settings         NormalSettings
    normals          (N, 3) float64   out: unit normal towards the sensor in base axes, and the weight of the
                                      point: 1 or more on a planar piece, settings.rough_weight elsewhere, 0
                                      where the beam grazes too much. An error of the range moves the point
                                      along its beam, so across a wall it counts by the cosine of the
                                      incidence: the weight is 1 head-on, settings.grazing_weight at most
    """
    count = xy_base.shape[0]
    sums = np.zeros((count + 1, 5))  # of x, y, xx, xy, yy up to each point, relative to the sensor
    range_m = np.empty(count)
    first = np.empty(count, np.int64)  # of the run of points without a gap that each belongs to
    for i in range(count):
        x = xy_base[i, 0] - sensor_xy_m[0]
        y = xy_base[i, 1] - sensor_xy_m[1]
        sums[i + 1, 0] = sums[i, 0] + x
        sums[i + 1, 1] = sums[i, 1] + y
        sums[i + 1, 2] = sums[i, 2] + x * x
        sums[i + 1, 3] = sums[i, 3] + x * y
        sums[i + 1, 4] = sums[i, 4] + y * y
        range_m[i] = math.sqrt(x * x + y * y)
        first[i] = i
        if i > 0:
            gap_m = settings.gap_m + settings.gap_steps * angle_step_rad * min(range_m[i - 1], range_m[i])
            step_m = math.hypot(xy_base[i, 0] - xy_base[i - 1, 0], xy_base[i, 1] - xy_base[i - 1, 1])
            if step_m < gap_m:
                first[i] = first[i - 1]
    end = count  # of the run
    for i in range(count - 1, -1, -1):
        if i + 1 < count and first[i + 1] != first[i]:
            end = i + 1
        reach = settings.beams_each_side
        if range_m[i] > 0.0:
            wanted = settings.half_length_m / (angle_step_rad * range_m[i])
            reach = int(min(max(wanted, settings.beams_each_side), settings.most_beams_each_side))
        low = max(first[i], i - reach)
        high = min(end, i + reach + 1)
        n = high - low
        nx = 1.0
        ny = 0.0
        if range_m[i] > 0.0:
            nx = (sensor_xy_m[0] - xy_base[i, 0]) / range_m[i]
            ny = (sensor_xy_m[1] - xy_base[i, 1]) / range_m[i]
        weight = settings.rough_weight
        if n >= 3:
            sx = sums[high, 0] - sums[low, 0]
            sy = sums[high, 1] - sums[low, 1]
            a = sums[high, 2] - sums[low, 2] - sx * sx / n
            b = sums[high, 3] - sums[low, 3] - sx * sy / n
            c = sums[high, 4] - sums[low, 4] - sy * sy / n
            half = 0.5 * (a - c)
            root = math.sqrt(half * half + b * b)
            mean = 0.5 * (a + c)
            if half >= 0.0:  # eigenvector of the small eigenvalue, from the form that cancels nothing
                ex = -b
                ey = half + root
            else:
                ex = half - root
                ey = b
            length = math.sqrt(ex * ex + ey * ey)
            if length > 0.0:
                ex /= length
                ey /= length
                cosine = ex * nx + ey * ny
                if cosine < 0.0:
                    ex = -ex
                    ey = -ey
                    cosine = -cosine
                nx = ex
                ny = ey
                thick_m = settings.planar_m * cosine + WALL_M
                thin = mean - root < n * thick_m * thick_m
                if thin and mean - root < settings.planar_ratio * (mean + root):
                    weight = 0.0
                    if cosine >= settings.least_cos_incidence:
                        square = cosine * cosine
                        weight = 1.0 / (square + (1.0 - square) / settings.grazing_weight)
        normals[i, 0] = nx
        normals[i, 1] = ny
        normals[i, 2] = weight
