"""Occupancy by counts: how often each cell was hit and how often a beam passed through it.

Probability and likelihood follow from the two counts.
"""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float32_3D, Float64_1D, Float64_2D, UInt16_3D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.rays import begin_ray, next_cell
from service.kernels.surfels import TILE_BITS, TILE_MASK
from service.kernels.tiles import NO_TILE, TileIndex, find_tile, take_slot

MAX_COUNT = 65_535


class CountedGrid(NamedTuple):
    """A map of counts.

    tiles     TileIndex                      tiles of TILE_CELLS a side
    hits      (capacity, T, T) uint16        c_o: scans with an end point in the cell
    passes    (capacity, T, T) uint16        c_f: scans with a beam through it, and none ending in it
    field     (capacity, T, T) float32       likelihood of an end point: the probability of a cell that was
                                             ever hit, else 0
    touched   (capacity, T, T) uint16        number of the scan that last counted in a cell
    cell_m    float
    """

    tiles: TileIndex
    hits: UInt16_3D
    passes: UInt16_3D
    field: Float32_3D
    touched: UInt16_3D
    cell_m: float


class CountWeights(NamedTuple):
    """Log-odds O_o of one hit and O_f of one beam passing through."""

    hit: float
    passed: float


@inner_kernel
def occupied_probability(hits, passes, weights):
    """p = O_o^c_o O_f^c_f / (O_o^c_o O_f^c_f + (1 - O_o)^c_o (1 - O_f)^c_f), computed by log-odds.

    hits, passes   int
    weights        CountWeights
    Source: Zhang et al. 2016, eqs. 6 to 8; eq. 8, missing in print, is the normalised product of the odds.
    """
    return 1.0 / (1.0 + math.exp(-(hits * weights.hit + passes * weights.passed)))


@inner_kernel
def touch_counted(grid, tile_row, tile_column):
    """Slot of a tile, created if absent."""
    slot = find_tile(grid.tiles, tile_row, tile_column)
    if slot == NO_TILE:
        slot, used_before = take_slot(grid.tiles, tile_row, tile_column)
        if used_before:
            grid.hits[slot] = np.uint16(0)
            grid.passes[slot] = np.uint16(0)
            grid.field[slot] = np.float32(0.0)
            grid.touched[slot] = np.uint16(0)
    return slot


@inner_kernel
def count_beam(u, v, du, dv, grid, hits, passes, field, touched, weights, scan_number):
    """Count the cells between two points as passed, except that of the end point.

    u, v          float         start, in cells
    du, dv        float         from start to end, in cells
    grid          CountedGrid   in and out; its arrays are also passed, hoisted out of the loop
    weights       CountWeights
    scan_number   uint16
    Source: Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, 1987.
    """
    column, row, step_column, step_row, next_column, next_row, per_column, per_row, count = begin_ray(
        u, v, du, dv
    )
    tile_row = row >> TILE_BITS
    tile_column = column >> TILE_BITS
    slot = touch_counted(grid, tile_row, tile_column)
    for _ in range(count):
        if row >> TILE_BITS != tile_row or column >> TILE_BITS != tile_column:
            tile_row = row >> TILE_BITS
            tile_column = column >> TILE_BITS
            slot = touch_counted(grid, tile_row, tile_column)
        r = row & TILE_MASK
        q = column & TILE_MASK
        if touched[slot, r, q] != scan_number:
            touched[slot, r, q] = scan_number
            passed = min(np.int64(passes[slot, r, q]) + 1, MAX_COUNT)
            passes[slot, r, q] = passed
            if hits[slot, r, q] > 0:
                field[slot, r, q] = occupied_probability(hits[slot, r, q], passed, weights)
        column, row, next_column, next_row = next_cell(
            column, row, step_column, step_row, next_column, next_row, per_column, per_row
        )


@kernel(Float64_2D, Float64_1D, Float64_1D, CountedGrid, CountWeights, float, int, np.uint16)
def count_scan(xy_base, sensor_xy_m, pose, grid, weights, free_range_m, pass_stride, scan_number):
    """Count a scan, each cell once: end points first, so that no beam clears a cell that another one hit.

    Counts saturate.

    xy_base        (N, 2) float64   end points, m, base frame
    sensor_xy_m    (2,)   float64   start of the beams, m, base frame
    pose           (3,)   float64   base in the frame of the grid
    grid           CountedGrid      in and out; its index covers end points and sensor
    weights        CountWeights
    free_range_m   float            length up to which beams clear cells
    pass_stride    int              every so many beams clear cells; all of them hit
    scan_number    uint16           differs from that of the last scan, and is not 0
    Source: Zhang et al. 2016, section 2.1.1.
    """
    hits, passes, field, touched = grid.hits, grid.passes, grid.field, grid.touched
    cell_m = grid.cell_m
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    for i in range(xy_base.shape[0]):
        column = math.floor((pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) / cell_m)
        row = math.floor((pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) / cell_m)
        slot = touch_counted(grid, row >> TILE_BITS, column >> TILE_BITS)
        r = row & TILE_MASK
        q = column & TILE_MASK
        if touched[slot, r, q] == scan_number:
            continue
        touched[slot, r, q] = scan_number
        hit = min(np.int64(hits[slot, r, q]) + 1, MAX_COUNT)
        hits[slot, r, q] = hit
        field[slot, r, q] = occupied_probability(hit, passes[slot, r, q], weights)
    u = (pose[0] + c * sensor_xy_m[0] - s * sensor_xy_m[1]) / cell_m
    v = (pose[1] + s * sensor_xy_m[0] + c * sensor_xy_m[1]) / cell_m
    for i in range(0, xy_base.shape[0], pass_stride):
        du = (pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) / cell_m - u
        dv = (pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) / cell_m - v
        shrink = min(1.0, free_range_m / cell_m / max(math.hypot(du, dv), 1e-9))
        count_beam(u, v, shrink * du, shrink * dv, grid, hits, passes, field, touched, weights, scan_number)


@kernel(Float64_2D, Float64_1D, CountedGrid, int)
def count_overlap(xy_base, pose, grid, reach_cells):
    """Number of points on walls and in free space.

    A point is on a wall if a cell within reach_cells of it along both axes is more probably occupied than
    free.
    It is in free space if beams passed through its cell and none ended there. Otherwise it is on unknown
    ground.

    xy_base       (N, 2) float64   m, base frame
    pose          (3,)   float64   base in the frame of the grid
    grid          CountedGrid
    reach_cells   int
    Returns (on walls, in free space).
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    on_walls = 0
    in_free = 0
    for i in range(xy_base.shape[0]):
        column = math.floor((pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) / grid.cell_m)
        row = math.floor((pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) / grid.cell_m)
        is_on_wall = False
        for r in range(row - reach_cells, row + reach_cells + 1):
            for q in range(column - reach_cells, column + reach_cells + 1):
                slot = find_tile(grid.tiles, r >> TILE_BITS, q >> TILE_BITS)
                if slot != NO_TILE and grid.field[slot, r & TILE_MASK, q & TILE_MASK] > 0.5:
                    is_on_wall = True
        slot = find_tile(grid.tiles, row >> TILE_BITS, column >> TILE_BITS)
        if is_on_wall:
            on_walls += 1
        elif slot != NO_TILE:
            r = row & TILE_MASK
            q = column & TILE_MASK
            if grid.passes[slot, r, q] > 0 and grid.hits[slot, r, q] == 0:
                in_free += 1
    return on_walls, in_free


@kernel(Float64_2D, float)
def weigh_scan(values, floor):
    """Log-likelihood of a scan: the sum over its beams of log(floor + (1 - floor) likelihood).

    values   (N, 3) float64   from read_field
    floor    float            of a beam that ends in a cell without hits
    Returns (log-likelihood, mean likelihood).
    """
    total = 0.0
    mean = 0.0
    for i in range(values.shape[0]):
        total += math.log(floor + (1.0 - floor) * values[i, 0])
        mean += values[i, 0]
    return total, mean / max(values.shape[0], 1)
