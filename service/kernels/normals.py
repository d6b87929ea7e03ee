"""Direction of the wall at each end point, from the beams beside it."""

import math
from typing import NamedTuple

from numba import njit


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


@njit(cache=True, nogil=True)
def estimate_normals(xy_base, sensor_xy_m, angle_step_rad, settings, normals):
    """Principal axes of each point and its contiguous neighbours.

    xy_base          (N, 2) float64   end points in beam order, m, base frame
    sensor_xy_m      (2,)   float64   where the beams start, m, base frame
    angle_step_rad   float            between neighbouring beams, > 0
    settings         NormalSettings
    normals          (N, 3) float64   out: unit normal towards the sensor in base axes, and the weight of the
                                      point: 1 on a planar piece, settings.rough_weight elsewhere, 0 where the beam grazes
    """
    count = xy_base.shape[0]
    half_length_squared = settings.half_length_m * settings.half_length_m
    for i in range(count):
        bx = sensor_xy_m[0] - xy_base[i, 0]
        by = sensor_xy_m[1] - xy_base[i, 1]
        range_m = math.sqrt(bx * bx + by * by)
        gap = settings.gap_m + settings.gap_steps * angle_step_rad * range_m
        gap_squared = gap * gap
        n = 1.0
        sx = sy = sxx = sxy = syy = 0.0  # relative to point i, so nothing cancels far from the base
        for side in (-1, 1):
            last_x = 0.0
            last_y = 0.0
            for k in range(1, settings.most_beams_each_side + 1):
                j = i + side * k
                if j < 0 or j >= count:
                    break
                dx = xy_base[j, 0] - xy_base[i, 0]
                dy = xy_base[j, 1] - xy_base[i, 1]
                if (dx - last_x) ** 2 + (dy - last_y) ** 2 >= gap_squared:
                    break
                if k > settings.beams_each_side and dx * dx + dy * dy > half_length_squared:
                    break
                last_x = dx
                last_y = dy
                n += 1.0
                sx += dx
                sy += dy
                sxx += dx * dx
                sxy += dx * dy
                syy += dy * dy
        weight = settings.rough_weight
        if range_m > 0.0:
            nx = bx / range_m
            ny = by / range_m
        else:
            nx = 1.0
            ny = 0.0
        if n >= 3.0:
            a = sxx - sx * sx / n
            b = sxy - sx * sy / n
            c = syy - sy * sy / n
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
            if length > 0.0 and mean + root > 0.0:
                ex /= length
                ey /= length
                cosine = ex * nx + ey * ny
                if cosine < 0.0:
                    ex = -ex
                    ey = -ey
                    cosine = -cosine
                nx = ex
                ny = ey
                if mean - root < settings.planar_ratio * (mean + root):
                    weight = 1.0 if cosine >= settings.least_cos_incidence else 0.0
        normals[i, 0] = nx
        normals[i, 1] = ny
        normals[i, 2] = weight
