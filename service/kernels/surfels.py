"""Surfels: mean and normal of the end points in a cell, one for each side of a wall."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from service.kernels.tiles import NO_TILE, TileIndex, find_tile, take_slot

TILE_BITS = 5
TILE_CELLS = 1 << TILE_BITS
TILE_MASK = TILE_CELLS - 1
# Columns of a surfel: how many points it stands for, mean relative to the centre of its cell (m), unit normal.
COUNT, MEAN_X, MEAN_Y, NORMAL_X, NORMAL_Y = range(5)


class SurfelGrid(NamedTuple):
    """One sub-map.

    index     TileIndex                        tiles of TILE_CELLS a side
    surfels   (capacity, T, T, 2, 5)  float32  two surfels a cell, facing apart
    field     (capacity, T, T)        float32  likelihood of an end point, read by the coarse stage
    cell_m    float
    """

    index: TileIndex
    surfels: npt.NDArray[np.float32]
    field: npt.NDArray[np.float32]
    cell_m: float


@njit(cache=True, nogil=True)
def touch_tile(grid, tile_row, tile_column):
    """Slot of a tile of the grid; made, and cleared, where there was none."""
    slot = find_tile(grid.index, tile_row, tile_column)
    if slot == NO_TILE:
        slot, used_before = take_slot(grid.index, tile_row, tile_column)
        if used_before:
            grid.surfels[slot] = np.float32(0.0)
            grid.field[slot] = np.float32(0.0)
    return slot


@njit(cache=True, nogil=True)
def insert_surfels(xy_base, normals, pose, grid, count_limit):
    """Merge the points of a scan into the surfels of a sub-map whose index covers them.

    xy_base       (N, 2) float64   m, base frame
    normals       (N, 3) float64   from estimate_normals; only planar points, of weight 1, are taken
    pose          (3,)   float64   pose of the base in the frame of the grid
    grid          SurfelGrid       in and out
    count_limit   float            a surfel forgets: it never stands for more points than this
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    limit = np.float32(count_limit)
    for i in range(xy_base.shape[0]):
        if normals[i, 2] < 1.0:
            continue
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        nx = np.float32(c * normals[i, 0] - s * normals[i, 1])
        ny = np.float32(s * normals[i, 0] + c * normals[i, 1])
        column = math.floor(x / grid.cell_m)
        row = math.floor(y / grid.cell_m)
        dx = np.float32(x - (column + 0.5) * grid.cell_m)
        dy = np.float32(y - (row + 0.5) * grid.cell_m)
        slot = touch_tile(grid, row >> TILE_BITS, column >> TILE_BITS)
        cell = grid.surfels[slot, row & TILE_MASK, column & TILE_MASK]
        side = 0
        if cell[0, COUNT] > 0.0 and cell[0, NORMAL_X] * nx + cell[0, NORMAL_Y] * ny <= 0.0:
            side = 1
        surfel = cell[side]
        n = min(surfel[COUNT], limit - np.float32(1.0))
        share = np.float32(1.0) / (n + np.float32(1.0))
        surfel[MEAN_X] += (dx - surfel[MEAN_X]) * share
        surfel[MEAN_Y] += (dy - surfel[MEAN_Y]) * share
        mx = n * surfel[NORMAL_X] + nx
        my = n * surfel[NORMAL_Y] + ny
        length = math.sqrt(mx * mx + my * my)
        if length > 0.0:
            surfel[NORMAL_X] = mx / length
            surfel[NORMAL_Y] = my / length
        surfel[COUNT] = n + np.float32(1.0)


@njit(cache=True, nogil=True)
def nearest_surfel(x, y, nx, ny, least_cosine, grid, surfel):
    """Nearest mean in the 3 x 3 cells around a point, among surfels that face the same way.

    x, y           float            m, frame of the grid
    nx, ny         float            normal of the point
    least_cosine   float            between the two normals; -2 takes any
    grid           SurfelGrid
    surfel         (5,) float64     out: mean x, mean y (m, frame of the grid), normal x, normal y, count
    Returns False where there is none.
    """
    cell_m = grid.cell_m
    column = math.floor(x / cell_m)
    row = math.floor(y / cell_m)
    best = np.inf
    local_row = row & TILE_MASK
    local_column = column & TILE_MASK
    inside = 0 < local_row < TILE_MASK and 0 < local_column < TILE_MASK
    slot = find_tile(grid.index, row >> TILE_BITS, column >> TILE_BITS)
    if inside and slot == NO_TILE:
        return False
    for r in range(row - 1, row + 2):
        for q in range(column - 1, column + 2):
            if not inside:
                slot = find_tile(grid.index, r >> TILE_BITS, q >> TILE_BITS)
                if slot == NO_TILE:
                    continue
            cell = grid.surfels[slot, r & TILE_MASK, q & TILE_MASK]
            for side in range(2):
                n = cell[side, COUNT]
                if n == 0.0:
                    break  # the second side is never filled before the first
                sx = np.float64(cell[side, NORMAL_X])
                sy = np.float64(cell[side, NORMAL_Y])
                if sx * nx + sy * ny <= least_cosine:
                    continue
                mx = (q + 0.5) * cell_m + cell[side, MEAN_X]
                my = (r + 0.5) * cell_m + cell[side, MEAN_Y]
                d = (mx - x) ** 2 + (my - y) ** 2
                if d < best:
                    best = d
                    surfel[0] = mx
                    surfel[1] = my
                    surfel[2] = sx
                    surfel[3] = sy
                    surfel[4] = n
    return best < np.inf
