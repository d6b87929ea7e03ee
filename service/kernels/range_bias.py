"""The systematic error of a sensor's ranges as a curve over range, as walls show it that are seen again."""

import math

import numpy as np

from service.kernels.compiled import kernel
from service.kernels.linear3 import solve_3x3
from service.kernels.match import point_information
from service.kernels.surfels import find_surfels

LEAST_COSINE = 0.1  # of the incidence: beams that graze more say nothing of a range


@kernel
def bias_at(curve_m, node_m, range_m):
    """Value of a curve between its nodes, m; beyond the last one that of the last.

    curve_m   (K,) float64   m at 0, node_m, 2 node_m, ...
    """
    at = range_m / node_m
    k = int(at)
    if k >= curve_m.shape[0] - 1:
        return curve_m[curve_m.shape[0] - 1]
    return curve_m[k] + (at - k) * (curve_m[k + 1] - curve_m[k])


@kernel
def shorten_ranges(xy, sensor_xy_m, curve_m, node_m, shortened):
    """Take the bias out of points, each along its beam.

    xy             (N, 2) float64   m
    sensor_xy_m    (2,)   float64   where the beams start, m
    curve_m        (K,)   float64   by which ranges are too long, at the nodes
    node_m         float            distance of the nodes
    shortened      (N, 2) float64   out: m; may be xy
    """
    for i in range(xy.shape[0]):
        x = xy[i, 0] - sensor_xy_m[0]
        y = xy[i, 1] - sensor_xy_m[1]
        range_m = math.sqrt(x * x + y * y)
        share = bias_at(curve_m, node_m, range_m) / range_m if range_m > 0.0 else 0.0
        shortened[i, 0] = xy[i, 0] - share * x
        shortened[i, 1] = xy[i, 1] - share * y


@kernel
def see_bias(xy_base, normals, pose, sensor_xy_m, grid, settings, node_m, information, weighted_m):
    """What a matched scan says of the bias at the nodes, whatever its pose; [21].

    xy_base        (N, 2) float64   m, base frame
    normals        (N, 3) float64   from estimate_normals
    pose           (3,)   float64   matched
    sensor_xy_m    (2,)   float64   where the beams start, m, base frame
    grid           SurfelGrid
    settings       MatchSettings
    node_m         float            distance of the nodes
    information    (K, K) float64   out: 1/m^2
    weighted_m     (K,)   float64   out: information times bias, 1/m
    """
    information[:, :] = 0.0
    weighted_m[:] = 0.0
    count = weighted_m.shape[0]
    found = np.empty((xy_base.shape[0], 6))
    find_surfels(xy_base, normals, pose, grid, settings.least_normal_cosine, found)
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    squared_cauchy = settings.cauchy_m * settings.cauchy_m
    H = np.zeros((3, 3))
    g = np.zeros(3)
    J = np.empty(3)
    cross = np.zeros((count, 3))
    solved = np.zeros((count, 3))
    for i in range(xy_base.shape[0]):
        if normals[i, 2] < 1.0 or found[i, 4] == 0.0:
            continue
        rx = c * xy_base[i, 0] - s * xy_base[i, 1]
        ry = s * xy_base[i, 0] + c * xy_base[i, 1]
        J[0] = found[i, 2]
        J[1] = found[i, 3]
        J[2] = J[1] * rx - J[0] * ry
        e = J[0] * (pose[0] + rx - found[i, 0]) + J[1] * (pose[1] + ry - found[i, 1])
        x = xy_base[i, 0] - sensor_xy_m[0]
        y = xy_base[i, 1] - sensor_xy_m[1]
        range_m = math.sqrt(x * x + y * y)
        cosine = -(J[0] * (c * x - s * y) + J[1] * (s * x + c * y)) / range_m
        if cosine < LEAST_COSINE:
            continue
        # At the range of the wall, not of the point: those that are short by chance are no sort of points.
        at = max(0.0, range_m + e / cosine) / node_m
        k = int(at)
        if k >= count - 1:
            continue
        weight = point_information(normals[i, 2], found[i, 4], found[i, 5], settings)
        weight /= 1.0 + e * e / squared_cauchy
        upper = (at - k) * cosine
        lower = cosine - upper
        information[k, k] += weight * lower * lower
        information[k + 1, k + 1] += weight * upper * upper
        information[k, k + 1] += weight * lower * upper
        information[k + 1, k] += weight * lower * upper
        weighted_m[k] -= weight * lower * e
        weighted_m[k + 1] -= weight * upper * e
        for m in range(3):
            g[m] += weight * e * J[m]
            cross[k, m] -= weight * lower * J[m]
            cross[k + 1, m] -= weight * upper * J[m]
            for n in range(3):
                H[m, n] += weight * J[m] * J[n]
    for m in range(3):
        H[m, m] += 1e-6 * (H[0, 0] + H[1, 1]) + 1e-6
    for k in range(count):
        if information[k, k] > 0.0:
            solve_3x3(H, cross[k], solved[k])
    for k in range(count):
        for m in range(3):
            weighted_m[k] -= solved[k, m] * g[m]
            for n in range(count):
                information[k, n] -= solved[k, m] * cross[n, m]
