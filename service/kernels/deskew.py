"""Ranges to end points, and deskewing: the motion during the sweep is removed beam by beam."""

import math
from typing import NamedTuple

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D, ReadonlyFloat32_1D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.normals import range_noise
from service.kernels.usual_gap import usual_gap


class Returns(NamedTuple):
    """Arrays for the returned beams of one scan."""

    xy_raw: Float64_2D  # (N, 2) m, base frame at each beam's own time
    beam_time_s: Float64_1D  # (N,) since one moment of the sweep
    beam: Int32_1D  # (N,) index of the beam in the scan


@inner_kernel
def is_inside(x, y, corners):
    """Whether a point lies within a polygon (C, 2); as service/geometry/polygons.py."""
    inside = False
    count = corners.shape[0]
    for k in range(count):
        x0 = corners[k, 0]
        y0 = corners[k, 1]
        x1 = corners[(k + 1) % count, 0]
        y1 = corners[(k + 1) % count, 1]
        if min(y0, y1) <= y < max(y0, y1) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            inside = not inside
    return inside


@kernel(ReadonlyFloat32_1D, Float64_2D, Float64_1D, Float64_1D, Float64_2D, float, float, Returns)
def project_returns(range_m, direction_base, mount_xy_m, gate_m, outline_m, beam_interval_s, late_s, returns):
    """End points of the beams that returned, each in the base frame at its own time.

    range_m           (N,)    float32   m; NaN without a return
    direction_base    (N, 2)  float64   unit vector of each beam in base axes
    mount_xy_m        (2,)    float64   the sensor in the base frame
    gate_m            (2,)    float64   nearest and farthest range that is used
    outline_m         (C, 2)  float64   corners of the vehicle, base frame: returns inside it are dropped
    beam_interval_s   float             from one beam to the next
    late_s            float             from beam 0 to the moment that the times are given from
    returns           Returns           out: arrays of at least N rows
    Returns (number of rows written; range noise in m, see range_noise; beams between returns, see usual_gap).
    """
    count = 0
    for i in range(range_m.shape[0]):
        r = range_m[i]
        if not (gate_m[0] <= r <= gate_m[1]):  # also skips NaN
            continue
        x = mount_xy_m[0] + r * direction_base[i, 0]
        y = mount_xy_m[1] + r * direction_base[i, 1]
        if is_inside(x, y, outline_m):
            continue
        returns.xy_raw[count, 0] = x
        returns.xy_raw[count, 1] = y
        returns.beam_time_s[count] = i * beam_interval_s - late_s
        returns.beam[count] = i
        count += 1
    beam = returns.beam[:count]
    return count, range_noise(returns.xy_raw[:count], beam, mount_xy_m), usual_gap(beam)


@kernel(Float64_2D, Float64_1D, Float64_1D, Float64_2D)
def deskew_points(xy_raw, beam_time_s, twist, xy_base):
    """Transform points to the base frame at beam 0, for a base with constant twist.

    xy_raw        (N, 2) float64   m, base frame at each point's own time
    beam_time_s   (N,)   float64   s since beam 0
    twist         (3,)   float64   m/s forward, m/s left, rad/s
    xy_base       (N, 2) float64   out: m, base frame at beam 0
    Source: exponential map of SE(2) in closed form; its Taylor series below 1e-6 rad.
    """
    for i in range(xy_raw.shape[0]):
        t = beam_time_s[i]
        turn = twist[2] * t
        forward = twist[0] * t
        left = twist[1] * t
        if abs(turn) < 1e-6:
            a = 1.0 - turn * turn / 6.0
            b = 0.5 * turn
            c = 1.0 - 0.5 * turn * turn
            s = turn
        else:
            c = math.cos(turn)
            s = math.sin(turn)
            a = s / turn
            half = math.sin(0.5 * turn)
            b = 2.0 * half * half / turn
        x = xy_raw[i, 0]
        y = xy_raw[i, 1]
        xy_base[i, 0] = a * forward - b * left + c * x - s * y
        xy_base[i, 1] = b * forward + a * left + s * x + c * y
