"""Normals of walls that a scan hits with two or three beams, by the points of several key frames.

A single scan cannot estimate such a normal, but the points of several scans lie beside each other on the
wall.
Each cell keeps the first and second moments of the points without a normal of their own, and what noise adds
to the moments; [27] of docs/estimator.md.

Sources: Biber, Strasser, The normal distributions transform, IROS 2003; Chan, Golub, LeVeque, Updating
formulae and a pairwise algorithm for computing sample variances, 1979.
"""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float32_5D, Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.normals import (
    ANGLE_SIGMA_RAD,
    MAX_ANGLE_SIGMAS,
    MIN_COS_INCIDENCE,
    ROUGH_WEIGHT,
    THICK_SIGMAS,
    WALL_M,
    small_eigenvector,
)
from service.kernels.surfels import REACH_CELLS, TILE_BITS, TILE_MASK
from service.kernels.tiles import NO_TILE, TileIndex, find_tile, slot_at, take_slot

# Key frames alternate between the halves: the noise of their normals is independent.
HALVES = 2
# Columns of a half: weights, 1 / noise^2 each; mean from the centre of the cell, m; weighted squares
# about it; squares of the beams' directions, which noise adds to those. Their trace counts the points.
WEIGHT, MOMENT_MEAN_X, MOMENT_MEAN_Y, XX, XY, YY, NOISE_XX, NOISE_XY, NOISE_YY = range(9)
MOMENTS = 9
MIN_POINTS = 6.0  # of a normal
MAX_POINTS = 200.0  # above it the moments of a half are halved
OFF_SIGMAS = 2.5  # a point farther off the plane of its cell does not belong to it
RESTART_POINTS = 12.0  # a cell with so many points that is no plane is cleared


class MomentGrid(NamedTuple):
    """Moments of one sub-map.

    tiles     TileIndex                             tiles of TILE_CELLS a side
    moments   (capacity, T, T, HALVES, MOMENTS)  float32
    cell_m    float
    """

    tiles: TileIndex
    moments: Float32_5D
    cell_m: float


@inner_kernel
def normal_of(xx, xy, yy, noise_xx, noise_xy, noise_yy, weight):
    """Normal (2,) of a plane by its weighted squares, less those of noise; [27].

    Also returns the squares across it, their expectation by noise, and the squares along it.
    """
    nx, ny = small_eigenvector(0.5 * (xx - noise_xx - yy + noise_yy), xy - noise_xy)
    if nx == 0.0 and ny == 0.0:
        return 1.0, 0.0, xx, 0.0, 0.0
    across = nx * nx * xx + 2.0 * nx * ny * xy + ny * ny * yy
    expected = nx * nx * noise_xx + 2.0 * nx * ny * noise_xy + ny * ny * noise_yy + weight * WALL_M * WALL_M
    along = ny * ny * (xx - noise_xx) - 2.0 * nx * ny * (xy - noise_xy) + nx * nx * (yy - noise_yy)
    return nx, ny, across, expected, along


@inner_kernel
def is_thin(across, expected, count):
    """Whether points lie on one plane: squares across are chi-square, count - 2 degrees of freedom."""
    return across <= expected * (1.0 + THICK_SIGMAS * math.sqrt(2.0 / (count - 2.0)))


@kernel(Float64_2D, Float64_1D, float, Float64_2D, Float64_2D, Float64_1D, MomentGrid, int)
def add_to_moments(xy_base, sensor_xy_m, range_sigma_m, normals, directed, pose, grid, half):
    """Add the points of a key frame that have no normal to the moments of their cells.

    xy_base         (N, 2) float64   m, base frame
    sensor_xy_m     (2,)   float64   start of the beams, m, base frame
    range_sigma_m   float            noise of a range
    normals         (N, 3) float64   from estimate_normals: points of ROUGH_WEIGHT are added
    directed        (N, 3) float64   from direct_by_moments: points of weight 0, off a plane, are left out
    pose            (3,)   float64   base in the frame of the grid
    grid            MomentGrid       in and out; its index covers the points
    half            int              half of this key frame, below HALVES
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
        dx = x - (column + 0.5) * cell_m - cell[MOMENT_MEAN_X]
        dy = y - (row + 0.5) * cell_m - cell[MOMENT_MEAN_Y]
        before = cell[WEIGHT]
        share = own / (before + own)
        cell[WEIGHT] = before + own
        cell[MOMENT_MEAN_X] += dx * share
        cell[MOMENT_MEAN_Y] += dy * share
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
            elif count > MAX_POINTS:
                for k in range(MOMENTS):
                    if k != MOMENT_MEAN_X and k != MOMENT_MEAN_Y:
                        cell[k] *= np.float32(0.5)


@inner_kernel
def is_known(across, expected, along, count):
    """Whether the normal of a plane is known to MAX_ANGLE_SIGMAS; arguments from normal_of."""
    most_rad2 = (MAX_ANGLE_SIGMAS * ANGLE_SIGMA_RAD) ** 2
    return max(across, expected) <= most_rad2 * along * count


@inner_kernel
def plane_near(pooled):
    """Normal (2,) of pooled moments (9,), see pool_cells.

    Also returns whether they are a plane, whether its normal is known, and the variance along it, m^2.
    """
    w = pooled[WEIGHT]
    wx = pooled[MOMENT_MEAN_X]
    wy = pooled[MOMENT_MEAN_Y]
    count = pooled[NOISE_XX] + pooled[NOISE_YY]
    nx, ny, across, expected, along = normal_of(
        pooled[XX] - wx * wx / w,
        pooled[XY] - wx * wy / w,
        pooled[YY] - wy * wy / w,
        pooled[NOISE_XX],
        pooled[NOISE_XY],
        pooled[NOISE_YY],
        w,
    )
    is_plane = is_thin(across, expected, count)
    return nx, ny, is_plane, is_plane and is_known(across, expected, along, count), along / w


@inner_kernel
def most_off_m2(cosine, noise_m2):
    """Square of the gate of a point's distance from its plane, m^2; cosine: of the incidence."""
    return OFF_SIGMAS * OFF_SIGMAS * (noise_m2 * cosine * cosine + WALL_M * WALL_M)


@inner_kernel
def is_within(nx, ny, along_m2, pooled, ux, uy, noise_m2):
    """Whether a point lies within a wall, far enough from its ends to belong to no other wall.

    nx, ny     float   normal of the wall
    along_m2   float   variance of its points along it, m^2; uniform distribution
    pooled     (9,)    from pool_cells
    ux, uy     float   unit vector to the sensor: noise moves points along the beam
    """
    beside_m = abs(ny * pooled[MOMENT_MEAN_X] - nx * pooled[MOMENT_MEAN_Y]) / pooled[WEIGHT]
    half_m = math.sqrt(3.0 * max(along_m2, 0.0))
    return beside_m <= half_m - math.sqrt(most_off_m2(ny * ux - nx * uy, noise_m2))


@inner_kernel
def pool_cells(grid, half, x, y, ux, uy, noise_m2, only_planes, pooled):
    """Pool the moments of the 3 x 3 cells around a point.

    grid, half    as in direct_by_moments
    x, y          float   m, the point in the frame of the grid
    ux, uy        float   unit vector to the sensor, in that frame
    noise_m2      float   variance of a range
    only_planes   bool    use only cells that by themselves are a plane through the point, with equal weights;
                          else all, weighted by distance
    pooled        (9,) float64   out: columns as in a cell; MOMENT_MEAN_X, MOMENT_MEAN_Y are weighted sums
    Returns the number of points.
    """
    moments = grid.moments
    slots = grid.tiles.slots  # hoisted: an index in the loop costs a reference
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cell_m = grid.cell_m
    per_square_reach = 1.0 / (REACH_CELLS * cell_m) ** 2
    cells_per_m = 1.0 / cell_m
    column = math.floor(x * cells_per_m)
    row = math.floor(y * cells_per_m)
    dx = x - (column + 0.5) * cell_m
    dy = y - (row + 0.5) * cell_m
    for k in range(MOMENTS):
        pooled[k] = 0.0
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
            mx = u * cell_m + cell[MOMENT_MEAN_X] - dx  # relative to the point: no cancellation
            my = v * cell_m + cell[MOMENT_MEAN_Y] - dy
            near = 1.0 - (mx * mx + my * my) * per_square_reach
            if near <= 0.0:
                continue
            near *= near
            if only_planes:
                near = 1.0
                count = cell[NOISE_XX] + cell[NOISE_YY]
                if count < MIN_POINTS:
                    continue
                nx, ny, across, expected, along = normal_of(
                    cell[XX], cell[XY], cell[YY], cell[NOISE_XX], cell[NOISE_XY], cell[NOISE_YY], cell[WEIGHT]
                )
                off = nx * mx + ny * my
                if (
                    not is_thin(across, expected, count)
                    or not is_known(across, expected, along, count)
                    or off * off > most_off_m2(nx * ux + ny * uy, noise_m2)
                ):
                    continue
            n = near * cell[WEIGHT]
            pooled[WEIGHT] += n
            pooled[MOMENT_MEAN_X] += n * mx
            pooled[MOMENT_MEAN_Y] += n * my
            pooled[XX] += near * cell[XX] + n * mx * mx
            pooled[XY] += near * cell[XY] + n * mx * my
            pooled[YY] += near * cell[YY] + n * my * my
            pooled[NOISE_XX] += near * cell[NOISE_XX]
            pooled[NOISE_XY] += near * cell[NOISE_XY]
            pooled[NOISE_YY] += near * cell[NOISE_YY]
    return pooled[NOISE_XX] + pooled[NOISE_YY]


@kernel(Float64_2D, Float64_1D, float, Float64_1D, MomentGrid, int, float, float, Float64_2D)
def direct_by_moments(
    xy_base, sensor_xy_m, range_sigma_m, pose, grid, half, grazing_weight, weight_off_plane, normals
):
    """Set the normals of points without one from the moments of the key frames.

    The moments of the 3 x 3 cells around a point are pooled, weighted by distance as surfels are. Where walls
    meet these are no plane; then only cells that are a plane by themselves are pooled.

    xy_base            (N, 2) float64   m, base frame
    sensor_xy_m        (2,)   float64   start of the beams, m, base frame
    range_sigma_m      float            noise of a range
    pose               (3,)   float64   base in the frame of the grid
    grid               MomentGrid
    half               int              half to read, below HALVES
    grazing_weight     float            as in estimate_normals
    weight_off_plane   float            of a point off the plane by more than noise
    normals            (N, 3) float64   in and out: from estimate_normals; points of ROUGH_WEIGHT are changed
    """
    noise_m2 = range_sigma_m * range_sigma_m
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    pooled = np.empty(MOMENTS)
    for i in range(xy_base.shape[0]):
        if normals[i, 2] != ROUGH_WEIGHT:
            continue
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        bx = sensor_xy_m[0] - xy_base[i, 0]
        by = sensor_xy_m[1] - xy_base[i, 1]
        length = math.sqrt(bx * bx + by * by)
        ux = (c * bx - s * by) / length  # to the sensor, in the frame of the grid
        uy = (s * bx + c * by) / length
        if pool_cells(grid, half, x, y, ux, uy, noise_m2, False, pooled) < MIN_POINTS:
            continue
        nx, ny, is_plane, knows_direction, _ = plane_near(pooled)
        if not is_plane:
            if pool_cells(grid, half, x, y, ux, uy, noise_m2, True, pooled) < MIN_POINTS:
                continue
            nx, ny, is_plane, knows_direction, along_m2 = plane_near(pooled)
            if not is_within(nx, ny, along_m2, pooled, ux, uy, noise_m2):
                continue
        if not knows_direction:
            continue
        cosine = nx * ux + ny * uy
        off_m = (nx * pooled[MOMENT_MEAN_X] + ny * pooled[MOMENT_MEAN_Y]) / pooled[WEIGHT]
        if off_m * off_m > most_off_m2(cosine, noise_m2):
            normals[i, 2] = weight_off_plane
            continue
        if abs(cosine) < MIN_COS_INCIDENCE:
            continue
        sign = 1.0 if cosine >= 0.0 else -1.0
        square = cosine * cosine
        normals[i, 0] = sign * (c * nx + s * ny)
        normals[i, 1] = sign * (-s * nx + c * ny)
        normals[i, 2] = 1.0 / (square + (1.0 - square) / grazing_weight)
