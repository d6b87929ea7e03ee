"""Hits and misses along beams, in tiles of the published map."""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int8_2D, Int8_3D, Int64_1D, UInt8_1D, UInt16_3D
from service.kernels.compiled import inner_kernel, kernel, seldom_kernel
from service.kernels.rays import begin_ray, next_cell
from service.kernels.tiles import NO_TILE, TileIndex, find_tile, take_slot

GRID_TILE_BITS = 6
GRID_TILE_CELLS = 1 << GRID_TILE_BITS
GRID_TILE_MASK = GRID_TILE_CELLS - 1


class OccupancyGrid(NamedTuple):
    """The published map.

    tiles      TileIndex
    evidence   (capacity, T, T) int8     log-odds in steps of the configured size; 0: unknown
    touched    (capacity, T, T) uint16   number of the scan that last changed a cell
    changed    (capacity,)      uint8    1: the tile changed since it was last published
    cell_m     float
    """

    tiles: TileIndex
    evidence: Int8_3D
    touched: UInt16_3D
    changed: UInt8_1D
    cell_m: float


class Evidence(NamedTuple):
    """Update of a cell by one scan, and its limits, in steps of log-odds."""

    hit: int
    miss: int
    least: int
    most: int


@inner_kernel
def touch_tile(grid, tile_row, tile_column):
    """Slot of a tile, created if absent."""
    slot = find_tile(grid.tiles, tile_row, tile_column)
    if slot == NO_TILE:
        slot, used_before = take_slot(grid.tiles, tile_row, tile_column)
        if used_before:
            grid.evidence[slot] = np.int8(0)
            grid.touched[slot] = np.uint16(0)
    return slot


@inner_kernel
def weigh_cell(old, amount, evidence):
    """Updated evidence of a cell; 0 is reserved for unknown."""
    new = min(max(old + amount, evidence.least), evidence.most)
    if new == 0:
        new = 1 if amount > 0 else -1
    return new


@inner_kernel
def cell_in_tiles(slot, row, column):
    """Flat index of a cell in the array of tiles; row and column in the map."""
    return (
        (slot << 2 * GRID_TILE_BITS) | ((row & GRID_TILE_MASK) << GRID_TILE_BITS) | (column & GRID_TILE_MASK)
    )


@kernel(Float64_2D, Float64_1D, Float64_1D, OccupancyGrid, Evidence, float, np.uint16)
def trace_scan(xy_base, sensor_xy_m, pose, grid, evidence, free_range_m, scan_number):
    """Update the cells that a scan observed: end points first, so that no beam clears a cell that another
    hit.

    A scan updates each cell once. A beam clears the cells before that of its end point.

    xy_base        (N, 2) float64   end points, m, base frame
    sensor_xy_m    (2,)   float64   start of the beams, m, base frame
    pose           (3,)   float64   base in the map frame
    grid           OccupancyGrid    in and out; its index covers end points and sensor
    evidence       Evidence
    free_range_m   float            length up to which beams clear cells
    scan_number    uint16           differs from that of the last scan, and is not 0
    Source: Thrun, Burgard, Fox, Probabilistic Robotics, table 9.1; Amanatides and Woo, A fast voxel traversal
    algorithm for ray tracing, 1987.
    """
    cells = grid.evidence.reshape(-1)  # hoisted: a reference inside the loop costs more than a cell
    touched = grid.touched.reshape(-1)
    changed = grid.changed
    cell_m = grid.cell_m
    count = xy_base.shape[0]
    ends = np.empty((count, 2))  # in cells, map frame
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    tile_row = tile_column = -(2**62)
    slot = np.int64(NO_TILE)
    for i in range(count):
        ends[i, 0] = (pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) / cell_m
        ends[i, 1] = (pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) / cell_m
        column = math.floor(ends[i, 0])
        row = math.floor(ends[i, 1])
        if row >> GRID_TILE_BITS != tile_row or column >> GRID_TILE_BITS != tile_column:
            tile_row = row >> GRID_TILE_BITS
            tile_column = column >> GRID_TILE_BITS
            slot = np.int64(touch_tile(grid, tile_row, tile_column))
        k = cell_in_tiles(slot, row, column)
        if touched[k] != scan_number:
            touched[k] = scan_number
            old = np.int64(cells[k])
            new = weigh_cell(old, evidence.hit, evidence)
            if new != old:
                cells[k] = np.int8(new)
                changed[slot] = np.uint8(1)
    u = (pose[0] + c * sensor_xy_m[0] - s * sensor_xy_m[1]) / cell_m
    v = (pose[1] + s * sensor_xy_m[0] + c * sensor_xy_m[1]) / cell_m
    touch_tile(grid, math.floor(v) >> GRID_TILE_BITS, math.floor(u) >> GRID_TILE_BITS)
    for i in range(count):
        du = ends[i, 0] - u
        dv = ends[i, 1] - v
        shrink = min(1.0, free_range_m / cell_m / max(math.hypot(du, dv), 1e-9))
        column, row, step_column, step_row, next_column, next_row, per_column, per_row, steps = begin_ray(
            u, v, shrink * du, shrink * dv
        )
        for _ in range(steps):
            if row >> GRID_TILE_BITS != tile_row or column >> GRID_TILE_BITS != tile_column:
                tile_row = row >> GRID_TILE_BITS
                tile_column = column >> GRID_TILE_BITS
                slot = np.int64(touch_tile(grid, tile_row, tile_column))
            k = cell_in_tiles(slot, row, column)
            if touched[k] != scan_number:
                touched[k] = scan_number
                old = np.int64(cells[k])
                new = weigh_cell(old, evidence.miss, evidence)
                if new != old:
                    cells[k] = np.int8(new)
                    changed[slot] = np.uint8(1)
            column, row, next_column, next_row = next_cell(
                column, row, step_column, step_row, next_column, next_row, per_column, per_row
            )


@inner_kernel
def evidence_at(grid, row, column):
    """Evidence of a cell, 0 without a tile."""
    slot = find_tile(grid.tiles, row >> GRID_TILE_BITS, column >> GRID_TILE_BITS)
    if slot == NO_TILE:
        return np.int64(0)
    return np.int64(grid.evidence[slot, row & GRID_TILE_MASK, column & GRID_TILE_MASK])


@kernel(Float64_2D, Float64_1D, OccupancyGrid)
def count_overlap(xy_base, pose, grid):
    """Number of points on walls and in free space.

    A point is on a wall if any of its 3 x 3 cells has evidence above 0, else in free space if its own cell
    has evidence below 0, else on unknown ground.

    xy_base   (N, 2) float64   m, base frame
    pose      (3,)   float64   base in the frame of the grid
    grid      OccupancyGrid
    Returns (on walls, in free space).
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    on_walls = 0
    in_free = 0
    for i in range(xy_base.shape[0]):
        column = math.floor((pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) / grid.cell_m)
        row = math.floor((pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) / grid.cell_m)
        own = evidence_at(grid, row, column)
        is_on_wall = own > 0
        for r in range(row - 1, row + 2):
            for q in range(column - 1, column + 2):
                is_on_wall = is_on_wall or evidence_at(grid, r, q) > 0
        if is_on_wall:
            on_walls += 1
        elif own < 0:
            in_free += 1
    return on_walls, in_free


@kernel(Int8_2D, float, Int8_2D)
def to_per_cent(evidence, per_step, cells):
    """Log-odds to occupancy in per cent; -1: unknown.

    evidence   (T, T) int8
    per_step   float         log-odds of one step
    cells      (T, T) int8   in and out
    Returns whether any cell changed.
    """
    per_cent = np.empty(256, np.int8)
    for value in range(-128, 128):
        per_cent[value + 128] = math.floor(100.0 / (1.0 + math.exp(-per_step * value)) + 0.5)
    per_cent[128] = -1
    differs = False
    for row in range(evidence.shape[0]):
        for column in range(evidence.shape[1]):
            shown = per_cent[np.int64(evidence[row, column]) + 128]
            if cells[row, column] != shown:
                cells[row, column] = shown
                differs = True
    return differs


@seldom_kernel(Int64_1D, Int64_1D, Int8_3D, OccupancyGrid)
def write_tiles(tile_row, tile_column, evidence, grid):
    """Replace all tiles of a map; tiles that are not among the new ones become unknown.

    tile_row, tile_column   (T,)        int64
    evidence                (T, W, W)   int8
    grid                    OccupancyGrid               in and out; its index covers them
    """
    slots = grid.tiles.slots
    kept = np.zeros(slots.shape, np.uint8)
    for k in range(tile_row.shape[0]):
        slot = touch_tile(grid, tile_row[k], tile_column[k])
        kept[tile_row[k] - grid.tiles.origin[0], tile_column[k] - grid.tiles.origin[1]] = 1
        for row in range(GRID_TILE_CELLS):
            for column in range(GRID_TILE_CELLS):
                if grid.evidence[slot, row, column] != evidence[k, row, column]:
                    grid.evidence[slot, row, column] = evidence[k, row, column]
                    grid.changed[slot] = np.uint8(1)
    for i in range(slots.shape[0]):
        for j in range(slots.shape[1]):
            slot = slots[i, j]
            if slot == NO_TILE or kept[i, j] == 1:
                continue
            for row in range(GRID_TILE_CELLS):
                for column in range(GRID_TILE_CELLS):
                    if grid.evidence[slot, row, column] != 0:
                        grid.evidence[slot, row, column] = np.int8(0)
                        grid.changed[slot] = np.uint8(1)
