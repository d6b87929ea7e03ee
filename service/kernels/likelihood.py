"""The coarse map: how likely an end point is at a place, splatted as one Gaussian a point."""

import math

import numpy as np
from numba import njit

from service.kernels.surfels import TILE_BITS, TILE_MASK, touch_tile
from service.kernels.tiles import NO_TILE, find_tile

SPLAT_REACH_CELLS = 4


@njit(cache=True, nogil=True)
def splat_likelihood(xy_base, pose, grid, sigma_m, enough):
    """Raise the field around each end point to exp(-d^2 / 2 sigma^2); the largest wins.

    xy_base    (N, 2) float64   m, base frame
    pose       (3,)   float64   pose of the base in the frame of the grid
    grid       SurfelGrid       in and out; its index covers the points and SPLAT_REACH_CELLS around them
    sigma_m    float
    enough     float            a point whose own cell is already this likely is passed over
    Source: Thrun, Burgard, Fox, Probabilistic Robotics, section 6.4, with a maximum for the sum.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    scale = -0.5 / (sigma_m * sigma_m)
    width = 2 * SPLAT_REACH_CELLS + 1
    along_x = np.empty(width, np.float32)
    for i in range(xy_base.shape[0]):
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        column = math.floor(x / grid.cell_m)
        row = math.floor(y / grid.cell_m)
        slot = touch_tile(grid, row >> TILE_BITS, column >> TILE_BITS)
        if grid.field[slot, row & TILE_MASK, column & TILE_MASK] >= enough:
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
                if value > grid.field[slot, r & TILE_MASK, q & TILE_MASK]:
                    grid.field[slot, r & TILE_MASK, q & TILE_MASK] = value


@njit(cache=True, nogil=True)
def field_cell(grid, row, column):
    """Likelihood in a cell; 0 where no tile lies."""
    slot = find_tile(grid.index, row >> TILE_BITS, column >> TILE_BITS)
    if slot == NO_TILE:
        return 0.0
    return np.float64(grid.field[slot, row & TILE_MASK, column & TILE_MASK])


@njit(cache=True, nogil=True)
def field_with_gradient(x, y, grid):
    """Likelihood at a point, bilinear between the centres of cells, and its gradient.

    x, y    float        m, frame of the grid
    grid    SurfelGrid
    Returns (likelihood, d/dx, d/dy); 1, 1/m, 1/m.
    Source: Kohlbrecher et al. 2011, eqs. (4) to (6).
    """
    u = x / grid.cell_m - 0.5
    v = y / grid.cell_m - 0.5
    column = math.floor(u)
    row = math.floor(v)
    a = u - column
    b = v - row
    local_row = row & TILE_MASK
    local_column = column & TILE_MASK
    if local_row < TILE_MASK and local_column < TILE_MASK:
        slot = find_tile(grid.index, row >> TILE_BITS, column >> TILE_BITS)
        if slot == NO_TILE:
            return 0.0, 0.0, 0.0
        tile = grid.field[slot]
        f00 = np.float64(tile[local_row, local_column])
        f01 = np.float64(tile[local_row, local_column + 1])
        f10 = np.float64(tile[local_row + 1, local_column])
        f11 = np.float64(tile[local_row + 1, local_column + 1])
    else:
        f00 = field_cell(grid, row, column)
        f01 = field_cell(grid, row, column + 1)
        f10 = field_cell(grid, row + 1, column)
        f11 = field_cell(grid, row + 1, column + 1)
    value = (1.0 - b) * ((1.0 - a) * f00 + a * f01) + b * ((1.0 - a) * f10 + a * f11)
    slope_x = ((1.0 - b) * (f01 - f00) + b * (f11 - f10)) / grid.cell_m
    slope_y = ((1.0 - a) * (f10 - f00) + a * (f11 - f01)) / grid.cell_m
    return value, slope_x, slope_y
