"""Occupancy likelihood map in which points of orthogonal segments weigh more."""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float32_3D, Float64_2D, Int32_2D, UInt8_3D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.surfels import TILE_BITS, TILE_MASK  # read_field knows tiles of this size
from service.kernels.tiles import NO_TILE, TileIndex, find_tile, take_slot

NOISY_OR, MAXIMUM = 0, 1
FULL = 255.0  # likelihood 1 in `cells`


class WeightedLayer(NamedTuple):
    """One resolution of the map.

    tiles        TileIndex
    likelihood   (capacity, T, T)  float32   in [0, 1]
    cells        (capacity, T, T)  uint8     the same in steps of 1/255, for the search
    cell_m       float
    """

    tiles: TileIndex
    likelihood: Float32_3D
    cells: UInt8_3D
    cell_m: float


@inner_kernel
def shares_of_three(offset, sigma, shares):
    """Shares of a Gaussian in the cell of its point and those on both sides, along one axis.

    offset   float          mean, from the centre of the middle cell, cells
    sigma    float          cells
    shares   (3,) float64   out: integral over [-1.5, -0.5], [-0.5, 0.5], [0.5, 1.5]; their sum is below 1
    Source: Qian et al. 2019, eqs. 17 and 18.
    """
    scale = 1.0 / (sigma * math.sqrt(2.0))
    below = math.erf((-1.5 - offset) * scale)
    for k in range(3):
        above = math.erf((k - 0.5 - offset) * scale)
        shares[k] = 0.5 * (above - below)
        below = above


@kernel(Float64_2D, Int32_2D, Float64_2D, bool, int, WeightedLayer)
def insert_weighted(xy_map, segment, sigma_cells, about_point, rule, layer):
    """Blur the points of a scan into 3 x 3 cells each.

    xy_map        (N, 2) float64   m, axes of the map; the index covers them and a cell around
    segment       (N, 2) int32     segments parallel to x and to y that the point is in; below 0: none
    sigma_cells   (4, 2) float64   sigma along x and y, cells, of points in none, in one parallel to x, in one
                                   parallel to y, in both
    about_point   bool             mean at the point; else at the centre of its cell, as eq. 17 is printed
    rule          int              NOISY_OR: p' = 1 - (1 - p)(1 - P); MAXIMUM: p' = max(p, P)
    layer         WeightedLayer    in and out
    Source: Qian et al. 2019, section 2.4; the rule of its figure 4 is not in the text.
    """
    along_x = np.empty(3)
    along_y = np.empty(3)
    likelihood = layer.likelihood
    cells = layer.cells
    tiles = layer.tiles
    for i in range(xy_map.shape[0]):
        u = xy_map[i, 0] / layer.cell_m
        v = xy_map[i, 1] / layer.cell_m
        column = math.floor(u)
        row = math.floor(v)
        kind = (1 if segment[i, 0] >= 0 else 0) + (2 if segment[i, 1] >= 0 else 0)
        shares_of_three(u - column - 0.5 if about_point else 0.0, sigma_cells[kind, 0], along_x)
        shares_of_three(v - row - 0.5 if about_point else 0.0, sigma_cells[kind, 1], along_y)
        for a in range(3):
            r = row + a - 1
            for b in range(3):
                q = column + b - 1
                slot = find_tile(tiles, r >> TILE_BITS, q >> TILE_BITS)
                if slot == NO_TILE:
                    slot = take_slot(tiles, r >> TILE_BITS, q >> TILE_BITS)[0]  # slots are never released
                before = np.float64(likelihood[slot, r & TILE_MASK, q & TILE_MASK])
                new = along_y[a] * along_x[b]
                after = 1.0 - (1.0 - before) * (1.0 - new) if rule == NOISY_OR else max(before, new)
                likelihood[slot, r & TILE_MASK, q & TILE_MASK] = after
                cells[slot, r & TILE_MASK, q & TILE_MASK] = np.uint8(FULL * after + 0.5)
