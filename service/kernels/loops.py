"""Kernels of loop closing: likelihood field, alignment, contradiction with free space, path lengths."""

import math

import numpy as np

from service.kernels.arrays import Bool_1D, Float32_2D, Float64_1D, Float64_2D, Int64_1D
from service.kernels.compiled import kernel
from service.kernels.linear3 import copy_matrix, solve_3x3
from service.kernels.match import MatchSettings
from service.kernels.occupancy import GRID_TILE_BITS, GRID_TILE_MASK, OccupancyGrid
from service.kernels.pose_information import wrap
from service.kernels.scan_information import scan_information
from service.kernels.surfel_equations import surfel_normal_equations
from service.kernels.surfels import SurfelGrid, find_surfels
from service.kernels.tiles import NO_TILE, find_tile

SPLAT_CELLS = 2


@kernel(Float64_2D, int, int, float, float, Float32_2D)
def splat_field(xy, first_row, first_column, cell_m, sigma_m, field):
    """Raise the likelihood of an end point around each point; the maximum is kept.

    xy                        (N, 2) float64   m, frame of the field
    first_row, first_column   int              of the cell that is field[0, 0]; all points lie in the field
    sigma_m                   float
    field                     (H, W) float32   in and out; 0 away from the points
    """
    scale = -0.5 / (sigma_m * sigma_m)
    for i in range(xy.shape[0]):
        column = math.floor(xy[i, 0] / cell_m)
        row = math.floor(xy[i, 1] / cell_m)
        for v in range(row - SPLAT_CELLS, row + SPLAT_CELLS + 1):
            r = v - first_row
            if r < 0 or r >= field.shape[0]:
                continue
            dy = (v + 0.5) * cell_m - xy[i, 1]
            for u in range(column - SPLAT_CELLS, column + SPLAT_CELLS + 1):
                q = u - first_column
                if q < 0 or q >= field.shape[1]:
                    continue
                dx = (u + 0.5) * cell_m - xy[i, 0]
                value = np.float32(math.exp(scale * (dx * dx + dy * dy)))
                if value > field[r, q]:
                    field[r, q] = value


@kernel(Float32_2D, int, int, OccupancyGrid, float)
def fill_unknown(field, first_row, first_column, grid, likelihood):
    """Raise the unknown cells of a map to a least likelihood.

    field                     (H, W) float32   in and out
    first_row, first_column   int              of the cell that is field[0, 0]
    grid                      OccupancyGrid    of the same cells; evidence 0 is unknown
    """
    for r in range(field.shape[0]):
        row = first_row + r
        slot = NO_TILE
        for q in range(field.shape[1]):
            column = first_column + q
            if q == 0 or column & GRID_TILE_MASK == 0:
                slot = find_tile(grid.tiles, row >> GRID_TILE_BITS, column >> GRID_TILE_BITS)
            if slot == NO_TILE or grid.evidence[slot, row & GRID_TILE_MASK, column & GRID_TILE_MASK] == 0:
                field[r, q] = max(field[r, q], np.float32(likelihood))


@kernel(Float64_2D, float, Bool_1D)
def thin_points(xy, spacing_m, kept):
    """Drop points closer than spacing_m to the last one kept.

    xy     (N, 2) float64   in beam order, m
    kept   (N,)   bool      out
    """
    last = -1
    for i in range(xy.shape[0]):
        kept[i] = last < 0 or math.hypot(xy[i, 0] - xy[last, 0], xy[i, 1] - xy[last, 1]) >= spacing_m
        if kept[i]:
            last = i


@kernel(Float64_2D, Float64_2D, SurfelGrid, MatchSettings, Float64_1D, Float64_2D)
def align_surfels(xy, normals, grid, settings, pose, information):
    """Gauss-Newton on surfels without a prior; directions without information keep their initial value.

    xy         (N, 2) float64   m, frame of the pose
    normals    (N, 3) float64   from estimate_normals
    grid       SurfelGrid
    settings   MatchSettings
    pose       (3,)   float64   in: initial; out: final, in the frame of the grid
    information (3, 3) float64  out: of the cloud alone, in the axes of the grid
    Returns (points used, inliers).
    """
    g = np.empty(3)
    step = np.empty(3)
    system = np.empty((3, 3))
    total = np.empty(3)
    H = np.empty((3, 3))
    shared = np.empty((3, 3))
    damping = np.empty((3, 3))
    found = np.empty((xy.shape[0], 6))
    evidence = np.empty((xy.shape[0], 7))
    used = 0
    inliers = 0
    for k in range(settings.iterations + 1):
        find_surfels(xy, normals, pose, grid, settings.least_normal_cosine, found)
        used, inliers = surfel_normal_equations(xy, normals, found, pose, settings, H, shared, g, evidence)
        scan_information(H, shared, evidence, settings.chance_chi2, damping, information)
        copy_matrix(information, system)
        weakest = 1e-3 * (H[0, 0] + H[1, 1])
        for i in range(3):
            system[i, i] += weakest + 1e-6
            total[i] = 0.0
            for j in range(3):
                total[i] += damping[i, j] * g[j]
        if k == settings.iterations or not solve_3x3(system, total, step):
            break
        for i in range(3):
            pose[i] -= step[i]
        if math.hypot(step[0], step[1]) < settings.settled_m and abs(step[2]) < settings.settled_rad:
            break
    pose[2] = wrap(pose[2])
    return used, inliers


@kernel(Float64_2D, Float64_1D, OccupancyGrid, int)
def share_in_free_space(xy, pose, grid, free):
    """Share of the points on known ground that lie in free space.

    xy      (N, 2) float64   m
    pose    (3,)   float64   of their frame in that of the grid
    grid    OccupancyGrid
    free    int              a point is in free space if its 3 x 3 cells have at most this evidence
    Returns a float in [0, 1].
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    known = 0
    against = 0
    for i in range(xy.shape[0]):
        column = math.floor((pose[0] + c * xy[i, 0] - s * xy[i, 1]) / grid.cell_m)
        row = math.floor((pose[1] + s * xy[i, 0] + c * xy[i, 1]) / grid.cell_m)
        all_free = True
        any_known = False
        for v in range(-1, 2):
            for u in range(-1, 2):
                slot = find_tile(grid.tiles, (row + v) >> GRID_TILE_BITS, (column + u) >> GRID_TILE_BITS)
                value = np.int64(0)
                if slot != NO_TILE:
                    value = np.int64(
                        grid.evidence[slot, (row + v) & GRID_TILE_MASK, (column + u) & GRID_TILE_MASK]
                    )
                any_known = any_known or value != 0
                all_free = all_free and value != 0 and value <= free
        known += any_known
        against += all_free
    return against / known if known > 0 else 0.0


@kernel(Float64_1D, Int64_1D, Int64_1D, float, int, Float64_1D)
def path_lengths(step_m, of, to, loop_m, start, length_m):
    """Shortest paths through a chain with loops from one of its poses to all others.

    step_m     (N,)  float64   path length from each pose to the next; the last entry is unused
    of, to     (E,)  int64     poses that a loop joins
    loop_m     float           cost of a loop, 0 or more
    start      int
    length_m   (N,)  float64   out
    Source: Bellman 1958; the chain is relaxed in both directions between two passes over the loops.
    """
    count = length_m.shape[0]
    length_m.fill(np.inf)
    length_m[start] = 0.0
    changed = True
    while changed:
        changed = False
        for i in range(1, count):
            length_m[i] = min(length_m[i], length_m[i - 1] + step_m[i - 1])
        for i in range(count - 2, -1, -1):
            length_m[i] = min(length_m[i], length_m[i + 1] + step_m[i])
        for k in range(of.shape[0]):
            if length_m[of[k]] + loop_m < length_m[to[k]] - 1e-9:
                length_m[to[k]] = length_m[of[k]] + loop_m
                changed = True
            if length_m[to[k]] + loop_m < length_m[of[k]] - 1e-9:
                length_m[of[k]] = length_m[to[k]] + loop_m
                changed = True
