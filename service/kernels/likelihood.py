"""The coarse map: likelihood of an end point in each cell, one Gaussian per point."""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float32_3D, Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.surfels import TILE_BITS, TILE_MASK, SurfelGrid, touch_tile
from service.kernels.tiles import NO_TILE, TileIndex, find_tile

SPLAT_REACH_CELLS = 4


class LikelihoodField(NamedTuple):
    """Likelihood of an end point in each cell, to align a scan with.

    tiles    TileIndex                       tiles of TILE_CELLS a side
    field    (capacity, T, T) float32        0 to 1
    cell_m   float
    """

    tiles: TileIndex
    field: Float32_3D
    cell_m: float


@kernel(Float64_2D, Float64_1D, SurfelGrid, float, float)
def splat_likelihood(xy_base, pose, grid, sigma_m, enough):
    """Raise the field around each end point to exp(-d^2 / 2 sigma^2); the maximum is kept.

    xy_base    (N, 2) float64   m, base frame
    pose       (3,)   float64   pose of the base in the frame of the grid
    grid       SurfelGrid       in and out; its index covers the points and SPLAT_REACH_CELLS around them
    sigma_m    float
    enough     float            points whose own cell has at least this likelihood are skipped
    Source: Thrun, Burgard, Fox, Probabilistic Robotics, section 6.4, with a maximum for the sum.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    scale = -0.5 / (sigma_m * sigma_m)
    width = 2 * SPLAT_REACH_CELLS + 1
    along_x = np.empty(width, np.float32)
    field = grid.field
    tiles = grid.tiles
    for i in range(xy_base.shape[0]):
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        column = math.floor(x / grid.cell_m)
        row = math.floor(y / grid.cell_m)
        slot = find_tile(tiles, row >> TILE_BITS, column >> TILE_BITS)
        if slot != NO_TILE and field[slot, row & TILE_MASK, column & TILE_MASK] >= enough:
            continue
        for k in range(width):
            dx = (column + k - SPLAT_REACH_CELLS + 0.5) * grid.cell_m - x
            along_x[k] = math.exp(scale * dx * dx)
        for r in range(row - SPLAT_REACH_CELLS, row + SPLAT_REACH_CELLS + 1):
            dy = (r + 0.5) * grid.cell_m - y
            along_y = np.float32(math.exp(scale * dy * dy))
            tile_column = np.int64(-(2**62))
            for k in range(width):
                q = column + k - SPLAT_REACH_CELLS
                if q >> TILE_BITS != tile_column:
                    tile_column = q >> TILE_BITS
                    slot = touch_tile(grid, r >> TILE_BITS, tile_column)
                value = along_y * along_x[k]
                if value > field[slot, r & TILE_MASK, q & TILE_MASK]:
                    field[slot, r & TILE_MASK, q & TILE_MASK] = value


@inner_kernel
def field_cell(field, tiles, row, column):
    """Likelihood in a cell; 0 without a tile."""
    slot = find_tile(tiles, row >> TILE_BITS, column >> TILE_BITS)
    if slot == NO_TILE:
        return 0.0
    return np.float64(field[slot, row & TILE_MASK, column & TILE_MASK])


@kernel(Float64_2D, Float64_1D, LikelihoodField, Float64_2D)
def read_field(xy_base, pose, likelihood, values):
    """Likelihood at points, bilinear between the centres of cells, and its gradient.

    xy_base      (N, 2) float64   m, base frame
    pose         (3,)   float64   base in the frame of the field
    likelihood   LikelihoodField
    values       (N, 3) float64   out: likelihood, d/dx and d/dy in 1/m
    Source: Kohlbrecher et al. 2011, eqs. (4) to (6).
    """
    tiles, field, cell_m = likelihood
    slots = tiles.slots  # hoisted, as in find_surfels
    first_row = tiles.origin[0]
    first_column = tiles.origin[1]
    cells_per_m = 1.0 / cell_m
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    for i in range(xy_base.shape[0]):
        u = (pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) * cells_per_m - 0.5
        v = (pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) * cells_per_m - 0.5
        column = math.floor(u)
        row = math.floor(v)
        q = column & TILE_MASK
        r = row & TILE_MASK
        if q < TILE_MASK and r < TILE_MASK:
            tile_row = (row >> TILE_BITS) - first_row
            tile_column = (column >> TILE_BITS) - first_column
            slot = NO_TILE
            if 0 <= tile_row < slots.shape[0] and 0 <= tile_column < slots.shape[1]:
                slot = slots[tile_row, tile_column]
            if slot == NO_TILE:
                values[i, 0] = values[i, 1] = values[i, 2] = 0.0
                continue
            f00 = np.float64(field[slot, r, q])
            f01 = np.float64(field[slot, r, q + 1])
            f10 = np.float64(field[slot, r + 1, q])
            f11 = np.float64(field[slot, r + 1, q + 1])
        else:
            f00 = field_cell(field, tiles, row, column)
            f01 = field_cell(field, tiles, row, column + 1)
            f10 = field_cell(field, tiles, row + 1, column)
            f11 = field_cell(field, tiles, row + 1, column + 1)
        a = u - column
        b = v - row
        values[i, 0] = (1.0 - b) * ((1.0 - a) * f00 + a * f01) + b * ((1.0 - a) * f10 + a * f11)
        values[i, 1] = ((1.0 - b) * (f01 - f00) + b * (f11 - f10)) * cells_per_m
        values[i, 2] = ((1.0 - a) * (f10 - f00) + a * (f11 - f01)) * cells_per_m
