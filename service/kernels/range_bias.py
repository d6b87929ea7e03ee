"""Systematic range error of a laser, constant and as a curve over range, from walls seen again."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Float64_3D, Int32_1D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.linear3 import solve_3x3
from service.kernels.match import MatchSettings
from service.kernels.normals import GRAZING_WEIGHT, ROUND_OBJECT_M, estimate_normals
from service.kernels.posts import MIN_POST_SHARE, find_posts
from service.kernels.rays import BEHIND_M
from service.kernels.surfel_equations import point_information
from service.kernels.surfels import (
    COSINES,
    COUNT,
    LASERS,
    NORMAL_X,
    NORMAL_Y,
    SAME_WALL_COSINE,
    TILE_BITS,
    TILE_MASK,
    SurfelGrid,
    find_surfels,
)
from service.kernels.tiles import NO_TILE, find_tile

NODE_M = 0.5  # of the curve of the bias over range; its correlation length
MIN_INCIDENCE_COSINE = 0.1  # beams that graze more carry no information about the range


@inner_kernel
def bias_at(curve_m, range_m):
    """Linear interpolation of a curve, m; constant beyond the last node.

    curve_m   (K,) float64   m at 0, NODE_M, 2 NODE_M, ...
    """
    at = range_m / NODE_M
    k = int(at)
    if k >= curve_m.shape[0] - 1:
        return curve_m[curve_m.shape[0] - 1]
    return curve_m[k] + (at - k) * (curve_m[k + 1] - curve_m[k])


@inner_kernel
def subtract_bias(xy, sensor_xy_m, curve_m, shortened):
    """Subtract the bias from points (N, 2), each along its beam; shortened: out, (N, 2)."""
    for i in range(xy.shape[0]):
        x = xy[i, 0] - sensor_xy_m[0]
        y = xy[i, 1] - sensor_xy_m[1]
        range_m = math.sqrt(x * x + y * y)
        share = bias_at(curve_m, range_m) / range_m if range_m > 0.0 else 0.0
        shortened[i, 0] = xy[i, 0] - share * x
        shortened[i, 1] = xy[i, 1] - share * y


@kernel(
    Float64_2D, Float64_2D, Int32_1D, Float64_1D, Float64_1D, float, float, int, int, Float64_3D, Float64_2D
)
def walls_of_scan(
    xy_raw, xy_base, beam, sensor_xy_m, curve_m, range_sigma_m, spacing_rad, gap, beam_count, xy, normals
):
    """Subtract the range bias from a scan, then estimate its normals.

    xy_raw, xy_base, beam, range_sigma_m, spacing_rad   as of Points
    sensor_xy_m   (2,)   float64      start of the beams, m
    curve_m       (K,)   float64      bias of the ranges, see bias_at
    gap           int                 beams from one return to the next
    beam_count    int                 of the scan
    xy            (4, N, 2) float64   out: xy_raw and xy_base without bias; both, moved along their walls [24]
    normals       (N, 3) float64      out: from estimate_normals
    Returns whether most points are on posts.
    """
    raw, base, moved_raw, moved_base = xy[0], xy[1], xy[2], xy[3]
    subtract_bias(xy_raw, sensor_xy_m, curve_m, raw)
    subtract_bias(xy_base, sensor_xy_m, curve_m, base)
    estimate_normals(base, sensor_xy_m, spacing_rad, range_sigma_m, GRAZING_WEIGHT, normals, moved_base)
    for i in range(raw.shape[0]):  # some cm; rotation within the sweep neglected
        moved_raw[i, 0] = raw[i, 0] + (moved_base[i, 0] - base[i, 0])
        moved_raw[i, 1] = raw[i, 1] + (moved_base[i, 1] - base[i, 1])
    if raw.shape[0] < 3:
        return False
    _, _, on_posts = find_posts(
        raw, beam, gap, beam_count, spacing_rad, sensor_xy_m, BEHIND_M, ROUND_OBJECT_M
    )
    return on_posts >= max(MIN_POST_SHARE * raw.shape[0], 1)


@inner_kernel
def cosine_of_map(found, grid, laser):
    """Mean cosine of incidence of a laser on a point's wall, a row of find_surfels; nan: unknown."""
    column = math.floor(found[0] / grid.cell_m)
    row = math.floor(found[1] / grid.cell_m)
    slot = find_tile(grid.tiles, row >> TILE_BITS, column >> TILE_BITS)
    if slot == NO_TILE:
        return math.nan
    r = row & TILE_MASK
    q = column & TILE_MASK
    for side in range(2):
        if grid.surfels[slot, r, q, side, COUNT] == 0.0:
            break
        nx = grid.surfels[slot, r, q, side, NORMAL_X]
        ny = grid.surfels[slot, r, q, side, NORMAL_Y]
        if nx * found[2] + ny * found[3] > SAME_WALL_COSINE:
            return np.float64(grid.surfels[slot, r, q, side, COSINES + laser])
    return math.nan


@kernel(
    Float64_2D,
    Float64_2D,
    Float64_1D,
    Float64_1D,
    int,
    SurfelGrid,
    MatchSettings,
    Float64_2D,
    Float64_1D,
)
def bias_information(xy_base, normals, pose, sensor_xy_m, laser, grid, settings, information, weighted_m):
    """Information of a matched scan about the bias, at the nodes and constant, with the pose marginalised;
    [21].

    xy_base        (N, 2) float64           m, base frame
    normals        (N, 3) float64           from estimate_normals
    pose           (3,)   float64           matched
    sensor_xy_m    (2,)   float64           start of the beams, m, base frame
    laser          int                      as in insert_surfels; LASERS: no information about the constant
    grid           SurfelGrid               with cosines
    settings       MatchSettings
    information    (K + 1, K + 1) float64   out: 1/m^2; the constant last
    weighted_m     (K + 1,)       float64   out: information times bias, 1/m
    """
    information[:, :] = 0.0
    weighted_m[:] = 0.0
    count = weighted_m.shape[0] - 1
    found = np.empty((xy_base.shape[0], 6))
    find_surfels(xy_base, normals, pose, grid, settings.least_normal_cosine, found)
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    squared_cauchy = settings.cauchy_m * settings.cauchy_m
    H = np.zeros((3, 3))
    g = np.zeros(3)
    J = np.empty(3)
    of = np.array([0, 0, count])  # indices of the Jacobian of a residual
    share = np.empty(3)  # its entries
    cross = np.zeros((count + 1, 3))
    solved = np.zeros((count + 1, 3))
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
        if cosine < MIN_INCIDENCE_COSINE:
            continue
        # At the range of the wall, not of the point: else the range noise would select the node.
        at = max(0.0, range_m + e / cosine) / NODE_M
        k = int(at)
        if k >= count - 1:
            continue
        weight = point_information(normals[i, 2], found[i, 4], found[i, 5], settings)
        weight /= 1.0 + e * e / squared_cauchy
        of[0] = k
        of[1] = k + 1
        share[1] = -(at - k) * cosine
        share[0] = -cosine - share[1]
        of_map = cosine_of_map(found[i], grid, laser) if laser < LASERS else math.nan
        share[2] = 0.0 if math.isnan(of_map) else of_map - cosine
        for a in range(3):
            weighted_m[of[a]] += weight * share[a] * e
            for b in range(3):
                information[of[a], of[b]] += weight * share[a] * share[b]
        for m in range(3):
            g[m] += weight * e * J[m]
            for a in range(3):
                cross[of[a], m] += weight * share[a] * J[m]
            for n in range(3):
                H[m, n] += weight * J[m] * J[n]
    for m in range(3):
        H[m, m] += 1e-6 * (H[0, 0] + H[1, 1]) + 1e-6
    for k in range(count + 1):
        if information[k, k] > 0.0:
            solve_3x3(H, cross[k], solved[k])
    for k in range(count + 1):
        for m in range(3):
            weighted_m[k] -= solved[k, m] * g[m]
            for n in range(count + 1):
                information[k, n] -= solved[k, m] * cross[n, m]
