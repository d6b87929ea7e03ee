"""Directions of walls that one scan hits with two or three beams, by the points of several key frames.

The far side of a sunk door is hit by a few beams only. One scan does not know its direction, but the points
of several scans lie beside each other on it. Each cell has the first and second moments of the points that
no scan by itself could give a direction, and of what noise adds to them; [27] of docs/estimator.md.

Sources: Biber, Strasser, The normal distributions transform, IROS 2003; Chan, Golub, LeVeque, Updating
formulae and a pairwise algorithm for computing sample variances, 1979.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.compiled import inner_kernel, kernel
from service.kernels.normals import (
    ANGLE_SIGMA_RAD,
    LEAST_COS_INCIDENCE,
    MOST_ANGLE,
    ROUGH_WEIGHT,
    THICK_SIGMAS,
    WALL_M,
)
from service.kernels.surfels import REACH_CELLS
from service.kernels.tiles import NO_TILE, TileIndex, find_tile, slot_at, take_slot

TILE_BITS = 4
TILE_CELLS = 1 << TILE_BITS
TILE_MASK = TILE_CELLS - 1
# Key frames go into the halves by turns: directions by one and by the other have no noise in common.
HALVES = 2
# Columns of a half: weights, 1 / noise^2 each; mean from the centre of the cell, m; weighted squares
# about it; squares of the beams' directions, which noise adds to those. Their trace counts the points.
WEIGHT, MEAN_X, MEAN_Y, XX, XY, YY, NOISE_XX, NOISE_XY, NOISE_YY = range(9)
MOMENTS = 9
LEAST_POINTS = 6.0  # that a direction is taken from
MOST_POINTS = 200.0  # then a half counts half: it forgets
OFF_SIGMAS = 2.5  # a point farther from the plane of its cell lies beside it: behind a corner, or in the air
RESTART_POINTS = 12.0  # a cell that is no plane with so many points begins anew without those behind a corner


class MomentGrid(NamedTuple):
    """Of one sub-map.

    tiles     TileIndex                             tiles of TILE_CELLS a side
    moments   (capacity, T, T, HALVES, MOMENTS)  float32
    cell_m    float
    """

    tiles: TileIndex
    moments: npt.NDArray[np.float32]
    cell_m: float


@inner_kernel
def normal_of(xx, xy, yy, noise_xx, noise_xy, noise_yy, weight):
    """Normal (2,) of the plane that squares about a mean show, without what noise adds to them; the squares
    across it, what noise explains of them, and the squares along it, all in units of the noise. [27]
    """
    half = 0.5 * (xx - noise_xx - yy + noise_yy)
    off = xy - noise_xy
    root = math.hypot(half, off)
    if half >= 0.0:  # eigenvector of the small eigenvalue, from the form that cancels nothing
        nx = -off
        ny = half + root
    else:
        nx = half - root
        ny = off
    length = math.sqrt(nx * nx + ny * ny)
    if length == 0.0:
        return 1.0, 0.0, xx, 0.0, 0.0
    nx /= length
    ny /= length
    across = nx * nx * xx + 2.0 * nx * ny * xy + ny * ny * yy
    expected = nx * nx * noise_xx + 2.0 * nx * ny * noise_xy + ny * ny * noise_yy + weight * WALL_M * WALL_M
    along = ny * ny * (xx - noise_xx) - 2.0 * nx * ny * (xy - noise_xy) + nx * nx * (yy - noise_yy)
    return nx, ny, across, expected, along


@inner_kernel
def is_thin(across, expected, count):
    """Whether so many points lie on one plane: what lies across is chi-square with count - 2 degrees."""
    return across <= expected * (1.0 + THICK_SIGMAS * math.sqrt(2.0 / (count - 2.0)))


@kernel
def add_to_moments(xy_base, sensor_xy_m, range_sigma_m, normals, directed, pose, grid, half):
    """Add those points of a key frame that have no direction of their own to the cells they lie in.

    xy_base         (N, 2) float64   m, base frame
    sensor_xy_m     (2,)   float64   where the beams start, m, base frame
    range_sigma_m   float            noise of a range
    normals         (N, 3) float64   from estimate_normals: points of ROUGH_WEIGHT are added, but for
    directed        (N, 3) float64   those of weight 0 here, which direct_by_moments has found off a plane
    pose            (3,)   float64   base in the frame of the grid
    grid            MomentGrid       in and out; its index covers the points
    half            int              of HALVES, that this key frame goes into
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    own = 1.0 / (range_sigma_m * range_sigma_m)
    moments = grid.moments
    cell_m = grid.cell_m
    cells_per_m = 1.0 / cell_m
    for i in range(xy_base.shape[0]):
        if normals[i, 2] != ROUGH_WEIGHT or directed[i, 2] == 0.0:
            continue
        bx = xy_base[i, 0] - sensor_xy_m[0]
        by = xy_base[i, 1] - sensor_xy_m[1]
        square = bx * bx + by * by
        if square == 0.0:
            continue
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        column = math.floor(x * cells_per_m)
        row = math.floor(y * cells_per_m)
        slot = np.int64(find_tile(grid.tiles, row >> TILE_BITS, column >> TILE_BITS))
        if slot == NO_TILE:
            slot, used_before = take_slot(grid.tiles, row >> TILE_BITS, column >> TILE_BITS)
            if used_before:
                moments[slot] = np.float32(0.0)
        cell = moments[slot, row & TILE_MASK, column & TILE_MASK, half]
        dx = x - (column + 0.5) * cell_m - cell[MEAN_X]
        dy = y - (row + 0.5) * cell_m - cell[MEAN_Y]
        before = cell[WEIGHT]
        share = own / (before + own)
        cell[WEIGHT] = before + own
        cell[MEAN_X] += dx * share
        cell[MEAN_Y] += dy * share
        cell[XX] += before * share * dx * dx
        cell[XY] += before * share * dx * dy
        cell[YY] += before * share * dy * dy
        ux = c * bx - s * by
        uy = s * bx + c * by
        cell[NOISE_XX] += ux * ux / square
        cell[NOISE_XY] += ux * uy / square
        cell[NOISE_YY] += uy * uy / square
        count = cell[NOISE_XX] + cell[NOISE_YY]
        if count >= RESTART_POINTS:
            _, _, across, expected, _ = normal_of(
                cell[XX], cell[XY], cell[YY], cell[NOISE_XX], cell[NOISE_XY], cell[NOISE_YY], cell[WEIGHT]
            )
            if not is_thin(across, expected, count):
                cell[:] = 0.0
            elif count > MOST_POINTS:
                for k in range(MOMENTS):
                    if k != MEAN_X and k != MEAN_Y:
                        cell[k] *= np.float32(0.5)


@kernel
def direct_by_moments(
    xy_base, sensor_xy_m, range_sigma_m, pose, grid, half, grazing_weight, weight_off_plane, normals
):
    """Give points without a direction of their own that of the plane which key frames have shown there.

    The moments of the 3 x 3 cells around a point count by their distance from it, as surfels do.

    xy_base            (N, 2) float64   m, base frame
    sensor_xy_m        (2,)   float64   where the beams start, m, base frame
    range_sigma_m      float            noise of a range
    pose               (3,)   float64   base in the frame of the grid
    grid               MomentGrid
    half               int              of HALVES, that directions are taken from
    grazing_weight     float            as in estimate_normals
    weight_off_plane   float            of a point that lies beside such a plane by more than noise explains
    normals            (N, 3) float64   in and out: from estimate_normals; points of ROUGH_WEIGHT are asked
    """
    moments = grid.moments
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cell_m = grid.cell_m
    cells_per_m = 1.0 / cell_m
    per_square_reach = 1.0 / (REACH_CELLS * cell_m) ** 2
    most_rad2 = (MOST_ANGLE * ANGLE_SIGMA_RAD) ** 2
    noise_m2 = range_sigma_m * range_sigma_m
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    for i in range(xy_base.shape[0]):
        if normals[i, 2] != ROUGH_WEIGHT:
            continue
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        column = math.floor(x * cells_per_m)
        row = math.floor(y * cells_per_m)
        dx = x - (column + 0.5) * cell_m
        dy = y - (row + 0.5) * cell_m
        w = wx = wy = xx = xy = yy = noise_xx = noise_xy = noise_yy = 0.0
        for v in range(-1, 2):
            for u in range(-1, 2):
                slot = slot_at(
                    slots,
                    ((row + v) >> TILE_BITS) - first_row,
                    ((column + u) >> TILE_BITS) - first_column,
                )
                if slot == NO_TILE:
                    continue
                cell = moments[slot, (row + v) & TILE_MASK, (column + u) & TILE_MASK, half]
                if cell[WEIGHT] == 0.0:
                    continue
                mx = u * cell_m + cell[MEAN_X] - dx  # from the point: nothing cancels
                my = v * cell_m + cell[MEAN_Y] - dy
                near = 1.0 - (mx * mx + my * my) * per_square_reach
                if near <= 0.0:
                    continue
                near *= near
                n = near * cell[WEIGHT]
                w += n
                wx += n * mx
                wy += n * my
                xx += near * cell[XX] + n * mx * mx
                xy += near * cell[XY] + n * mx * my
                yy += near * cell[YY] + n * my * my
                noise_xx += near * cell[NOISE_XX]
                noise_xy += near * cell[NOISE_XY]
                noise_yy += near * cell[NOISE_YY]
        count = noise_xx + noise_yy
        if count < LEAST_POINTS:
            continue
        nx, ny, across, expected, along = normal_of(
            xx - wx * wx / w, xy - wx * wy / w, yy - wy * wy / w, noise_xx, noise_xy, noise_yy, w
        )
        if not is_thin(across, expected, count) or max(across, expected) > most_rad2 * along * count:
            continue
        ux = sensor_xy_m[0] - xy_base[i, 0]
        uy = sensor_xy_m[1] - xy_base[i, 1]
        bx = c * nx + s * ny
        by = -s * nx + c * ny
        cosine = (bx * ux + by * uy) / math.sqrt(ux * ux + uy * uy)
        square = cosine * cosine
        off = (nx * wx + ny * wy) / w
        if off * off > OFF_SIGMAS * OFF_SIGMAS * (noise_m2 * square + WALL_M * WALL_M):
            normals[i, 2] = weight_off_plane
            continue
        if abs(cosine) < LEAST_COS_INCIDENCE:
            continue
        sign = 1.0 if cosine >= 0.0 else -1.0
        normals[i, 0] = sign * bx
        normals[i, 1] = sign * by
        normals[i, 2] = 1.0 / (square + (1.0 - square) / grazing_weight)
