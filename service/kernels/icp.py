"""Iterative closest point between two scans, point to point."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.ordering import order_rising
from service.kernels.pose_information import wrap


class IcpResult(NamedTuple):
    """step: pose of the newer base in the older one's frame.

    step         (3,) float64   x m, y m, theta rad
    rms_m        float          root mean square distance of the pairs; inf with too few pairs
    paired       int            points with a partner
    iterations   int
    """

    step: npt.NDArray[np.float64]
    rms_m: float
    paired: int
    iterations: int


@inner_kernel
def closest_points(xy, others, bearing_rad, most_m, partner):
    """The nearest of `others` for each point, searched outwards by bearing.

    A point at range r whose bearing differs by d is at least r sin d away, or r beyond a right angle. This
    bound ends the search after few points.

    xy            (N, 2) float64   m
    others        (M, 2) float64   m, by rising bearing; M > 0
    bearing_rad   (M,)   float64   atan2(y, x) of each
    most_m        float            largest distance of a partner
    partner       (N,)   int64     out: row of others, -1: none
    """
    count = others.shape[0]
    for n in range(xy.shape[0]):
        x = xy[n, 0]
        y = xy[n, 1]
        reach = math.hypot(x, y)
        own_rad = math.atan2(y, x)
        right = np.searchsorted(bearing_rad, own_rad) % count
        left = (right - 1) % count
        nearest = most_m * most_m
        partner[n] = -1
        right_open = left_open = True
        compared = 0
        while compared < count and (right_open or left_open):
            for side in range(2):
                if not (right_open if side == 0 else left_open) or compared == count:
                    continue
                at = right if side == 0 else left
                off_x = others[at, 0] - x
                off_y = others[at, 1] - y
                square = off_x * off_x + off_y * off_y
                compared += 1
                if square < nearest:
                    nearest = square
                    partner[n] = at
                ahead = x * others[at, 0] + y * others[at, 1] > 0.0
                bound = reach * abs(math.sin(bearing_rad[at] - own_rad)) if ahead else reach
                if side == 0:
                    right = right + 1 if right < count - 1 else 0
                    right_open = bound * bound < nearest
                else:
                    left = left - 1 if left > 0 else count - 1
                    left_open = bound * bound < nearest


@kernel(Float64_2D, Float64_2D, Float64_1D, float, int, float)
def icp_point_to_point(newer, older, start, most_m, iterations, settled):
    """The motion between two scans by point-to-point ICP.

    newer        (N, 2) float64   m, base frame of the newer scan
    older        (M, 2) float64   m, base frame of the older scan
    start        (3,)   float64   pose of the newer base in the older one's frame, initial guess
    most_m       float            largest distance of a pair
    iterations   int              upper bound
    settled      float            m and rad: a smaller step is the last
    Returns an IcpResult.
    Source: Tang et al. 2014, section 2.2; closed form in the plane as in Lu and Milios 1997, appendix B.
    """
    step = start.copy()
    partner = np.empty(newer.shape[0], np.int64)
    moved = np.empty((newer.shape[0], 2))
    if older.shape[0] == 0:
        return IcpResult(step, np.inf, 0, 0)
    bearing_rad = np.arctan2(older[:, 1], older[:, 0])
    order = np.empty(older.shape[0], np.int64)
    order_rising(bearing_rad, order)
    ordered = older[order]
    bearing_rad = bearing_rad[order]
    rms_m = np.inf
    paired = 0
    done = 0
    for iteration in range(iterations + 1):
        c = math.cos(step[2])
        s = math.sin(step[2])
        for n in range(newer.shape[0]):
            moved[n, 0] = step[0] + c * newer[n, 0] - s * newer[n, 1]
            moved[n, 1] = step[1] + s * newer[n, 0] + c * newer[n, 1]
        closest_points(moved, ordered, bearing_rad, most_m, partner)
        px = py = qx = qy = square = 0.0
        paired = 0
        for n in range(newer.shape[0]):
            if partner[n] < 0:
                continue
            at = partner[n]
            paired += 1
            px += newer[n, 0]
            py += newer[n, 1]
            qx += ordered[at, 0]
            qy += ordered[at, 1]
            square += (ordered[at, 0] - moved[n, 0]) ** 2 + (ordered[at, 1] - moved[n, 1]) ** 2
        if paired < 3:
            return IcpResult(start.copy(), np.inf, paired, iteration)
        rms_m = math.sqrt(square / paired)
        if done == 1 or iteration == iterations:
            return IcpResult(step, rms_m, paired, iteration)
        px /= paired
        py /= paired
        qx /= paired
        qy /= paired
        dot = cross = 0.0
        for n in range(newer.shape[0]):
            if partner[n] < 0:
                continue
            ax = newer[n, 0] - px
            ay = newer[n, 1] - py
            bx = ordered[partner[n], 0] - qx
            by = ordered[partner[n], 1] - qy
            dot += ax * bx + ay * by
            cross += ax * by - ay * bx
        theta = math.atan2(cross, dot)
        x = qx - math.cos(theta) * px + math.sin(theta) * py
        y = qy - math.sin(theta) * px - math.cos(theta) * py
        turn = abs(wrap(theta - step[2]))
        if math.hypot(x - step[0], y - step[1]) < settled and turn < settled:
            done = 1
        step[0], step[1], step[2] = x, y, theta
    return IcpResult(step, rms_m, paired, iterations)
