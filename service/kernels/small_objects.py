"""Small objects, as narrow as a person, who may move: how far they pull a match."""

import math

import numpy as np

from service.kernels.arrays import Bool_1D, Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.linear3 import solve_3x3
from service.kernels.normals import ROUND_OBJECT_M
from service.kernels.static_score import placed
from service.kernels.surfels import SurfelGrid, find_surfels

MIN_PULLING = 10  # returns of all such objects: fewer pull no match
# Between neighbouring returns: a larger one ends a run; the second for each metre between their beams.
RUN_GAP_M, RUN_GAP_STEPS = 0.3, 4.0


@kernel(Float64_2D, Float64_2D, Float64_1D, SurfelGrid, float, float, Float64_2D, Bool_1D, Float64_1D)
def pull_of_small_objects(
    xy_base, normals, pose, grid, least_cosine, variance_m2, prior_information, is_small, pull
):
    """How far runs narrower than ROUND_OBJECT_M pull a match from where the other returns put it.

    xy_base             (N, 2) float64   m, base frame, in the order of beams
    normals             (N, 3) float64   from estimate_normals; points of weight 0 count as neither
    pose                (3,)   float64   matched, base in the frame of the grid
    grid                SurfelGrid
    least_cosine        float            as in find_surfels
    variance_m2         float            of a range
    prior_information   (3, 3) float64   of the predicted pose, base axes
    is_small            (N,)   bool      out: in such a run
    pull                (3,)   float64   out: m, m, rad, by one Gauss-Newton step; 0 for few returns
    """
    count = mark_small_runs(xy_base, normals, is_small)
    pull[:] = 0.0
    if count < MIN_PULLING:
        return
    small_xy = np.empty((count, 2))
    small_normals = np.empty((count, 3))
    information = np.zeros((3, 3))
    row = np.empty(3)
    k = 0
    for i in range(xy_base.shape[0]):
        if is_small[i]:
            small_xy[k] = xy_base[i]
            small_normals[k] = normals[i]
            k += 1
        elif normals[i, 2] > 0.0:
            jacobian(xy_base[i], normals[i, 0], normals[i, 1], row)
            for a in range(3):
                for b in range(3):
                    information[a, b] += normals[i, 2] * row[a] * row[b]
    for a in range(3):
        for b in range(3):
            information[a, b] = information[a, b] / variance_m2 + prior_information[a, b]
    found = np.empty((count, 6))
    find_surfels(small_xy, small_normals, pose, grid, least_cosine, found)
    xy = placed(small_xy, pose)
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    gradient = np.zeros(3)
    for k in range(count):
        if found[k, 4] == 0.0:
            continue
        nx, ny = found[k, 2], found[k, 3]
        residual_m = nx * (xy[k, 0] - found[k, 0]) + ny * (xy[k, 1] - found[k, 1])
        jacobian(small_xy[k], c * nx + s * ny, c * ny - s * nx, row)
        for a in range(3):
            gradient[a] += small_normals[k, 2] * row[a] * residual_m / variance_m2
    solve_3x3(information, gradient, pull)


@inner_kernel
def jacobian(xy, nx, ny, row):
    """Derivative (3,) of a point's distance to a wall of a normal, by the pose; all in the base frame."""
    row[0] = nx
    row[1] = ny
    row[2] = xy[0] * ny - xy[1] * nx


@inner_kernel
def mark_small_runs(xy_base, normals, is_small):
    """Mark the returns with a weight in narrow runs; returns their number."""
    count = xy_base.shape[0]
    marked = 0
    begin = 0
    while begin < count:
        end = begin
        low_x = high_x = xy_base[begin, 0]
        low_y = high_y = xy_base[begin, 1]
        while True:
            x, y = xy_base[end, 0], xy_base[end, 1]
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
            end += 1
            if end == count:
                break
            u, v = xy_base[end, 0], xy_base[end, 1]
            beside_m = abs(x * v - y * u) / math.sqrt(max(x * x + y * y, u * u + v * v, 1e-12))
            if math.hypot(u - x, v - y) > RUN_GAP_M + RUN_GAP_STEPS * beside_m:
                break
        small = math.hypot(high_x - low_x, high_y - low_y) < ROUND_OBJECT_M
        for i in range(begin, end):
            is_small[i] = small and normals[i, 2] > 0.0
            marked += is_small[i]
        begin = end
    return marked
