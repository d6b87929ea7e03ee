"""Surfels: mean and normal of the end points in a cell, one surfel for each side of a wall."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.arrays import Float32_3D, Float32_5D, Float64_1D, Float64_2D
from service.kernels.compiled import inlined_kernel, inner_kernel, kernel
from service.kernels.tiles import NO_TILE, TileIndex, find_tile, slot_at, take_slot

TILE_BITS = 5
TILE_CELLS = 1 << TILE_BITS
TILE_MASK = TILE_CELLS - 1
# Columns of a surfel: points of equal noise that it stands for, mean from the centre of its cell (m), unit
# normal.
COUNT, MEAN_X, MEAN_Y, NORMAL_X, NORMAL_Y = range(5)
# Columns for the constant range bias: for each laser, the mean cosine of incidence over all points of a
# surfel, 0 for points of other lasers.
COSINES, LASERS = 5, 3
COLUMNS = COSINES + LASERS
SAME_WALL_COSINE = np.float32(0.7)  # between a point's normal and a surfel's; below it the other side is used
MIN_NORMAL_COSINE = 0.6  # between a point and a surfel of the same wall
SURFELS_AROUND = 18  # surfels in 3 x 3 cells
NO_ROW = -(2**62)  # row of no cell
REACH_CELLS = 1.25  # farther surfels are not averaged
PARTS = 2  # cells of a finer grid along the edge of a full cell; [32]
# Position of a round wall between the plane through the mean of its surfels and their own planes; [28]
ROUND_SHARE = 0.5 * (1.0 + 7.0 / (12.0 * REACH_CELLS * REACH_CELLS))


class SurfelGrid(NamedTuple):
    """One sub-map.

    tiles     TileIndex                                   tiles of TILE_CELLS a side
    surfels   (capacity, T, T, 2, 5 or COLUMNS) float32   two surfels a cell, with unlike normals
    field     (capacity, T, T)                  float32   likelihood of an end point, read by the coarse stage
    cell_m    float
    """

    tiles: TileIndex
    surfels: Float32_5D
    field: Float32_3D
    cell_m: float


class SurfelCache(NamedTuple):
    """Cache of the surfels around a scan's points, valid while no surfel changes.

    cell      (N, 2) int64     row and column in the grid of the cell searched for a point
    span      (N, 2) int64     first row in `surfels`, and count, of its surfels
    surfels   (M, 5) float64   points each stands for, mean from the centre of that cell (m), unit normal
    used      (1,)   int64     rows in use
    """

    cell: npt.NDArray[np.int64]
    span: npt.NDArray[np.int64]
    surfels: npt.NDArray[np.float64]
    used: npt.NDArray[np.int64]


@inner_kernel
def empty_cache(count):
    """An empty SurfelCache for so many points."""
    cache = SurfelCache(
        np.empty((count, 2), np.int64),
        np.empty((count, 2), np.int64),
        np.empty((4 * count + SURFELS_AROUND, 5)),
        np.empty(1, np.int64),
    )
    clear_cache(cache)
    return cache


@inner_kernel
def clear_cache(cache):
    """Empty the cache, also for use with another grid."""
    cache.used[0] = 0
    for i in range(cache.cell.shape[0]):
        cache.cell[i, 0] = NO_ROW


@inner_kernel
def touch_tile(grid, tile_row, tile_column):
    """Slot of a tile of the grid; created and cleared if absent."""
    slot = find_tile(grid.tiles, tile_row, tile_column)
    if slot == NO_TILE:
        slot, used_before = take_slot(grid.tiles, tile_row, tile_column)
        if used_before:
            grid.surfels[slot] = np.float32(0.0)
            grid.field[slot] = np.float32(0.0)
    return slot


@inner_kernel
def side_of(surfels, slot, row, column, nx, ny):
    """Index of the surfel of a cell for a point with this normal, float32."""
    cosine = surfels[slot, row, column, 0, NORMAL_X] * nx + surfels[slot, row, column, 0, NORMAL_Y] * ny
    if surfels[slot, row, column, 0, COUNT] > 0.0 and cosine < SAME_WALL_COSINE:
        other = surfels[slot, row, column, 1, NORMAL_X] * nx + surfels[slot, row, column, 1, NORMAL_Y] * ny
        if surfels[slot, row, column, 1, COUNT] == 0.0 or other > cosine:
            return 1
    return 0


@kernel(Float64_2D, Float64_2D, Float64_1D, SurfelGrid, float, float, Float64_1D, int)
def insert_surfels(xy_base, normals, pose, grid, count_limit, point_count, sensor_xy_m, laser):
    """Merge the points of a scan into the surfels of a sub-map whose index covers them.

    xy_base       (N, 2) float64   m, base frame
    normals       (N, 3) float64   from estimate_normals; only planar points, of weight 1 or more, are used
    pose          (3,)   float64   pose of the base in the frame of the grid
    grid          SurfelGrid       in and out
    count_limit   float            points of this noise that a surfel averages over; above it the count is
                                   constant and the mean still follows
    point_count   float            points of the noise that surfels count in which each stands for: the ratio
                                   of the variances
    sensor_xy_m   (2,)   float64   start of the beams, m, base frame
    laser         int              below LASERS; LASERS: none of them; -1: the surfels have no cosines
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    own = np.float32(point_count)
    limit = np.float32((count_limit - 1.0) * point_count)
    surfels = grid.surfels
    cell_m = grid.cell_m
    cells_per_m = 1.0 / cell_m
    tile_row = tile_column = NO_ROW
    slot = np.int64(NO_TILE)
    for i in range(xy_base.shape[0]):
        if normals[i, 2] < 1.0:
            continue
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        nx = np.float32(c * normals[i, 0] - s * normals[i, 1])
        ny = np.float32(s * normals[i, 0] + c * normals[i, 1])
        column = math.floor(x * cells_per_m)
        row = math.floor(y * cells_per_m)
        dx = np.float32(x - (column + 0.5) * cell_m)
        dy = np.float32(y - (row + 0.5) * cell_m)
        if row >> TILE_BITS != tile_row or column >> TILE_BITS != tile_column:
            tile_row = row >> TILE_BITS
            tile_column = column >> TILE_BITS
            slot = np.int64(touch_tile(grid, tile_row, tile_column))
        r = row & TILE_MASK
        q = column & TILE_MASK
        side = side_of(surfels, slot, r, q, nx, ny)
        n = surfels[slot, r, q, side, COUNT]
        if n > limit:
            n -= own
        share = own / (n + own)
        surfels[slot, r, q, side, MEAN_X] += (dx - surfels[slot, r, q, side, MEAN_X]) * share
        surfels[slot, r, q, side, MEAN_Y] += (dy - surfels[slot, r, q, side, MEAN_Y]) * share
        mx = n * surfels[slot, r, q, side, NORMAL_X] + own * nx
        my = n * surfels[slot, r, q, side, NORMAL_Y] + own * ny
        length = math.sqrt(mx * mx + my * my)
        if length > 0.0:
            surfels[slot, r, q, side, NORMAL_X] = mx / length
            surfels[slot, r, q, side, NORMAL_Y] = my / length
        surfels[slot, r, q, side, COUNT] = n + own
        if laser < 0:
            continue
        bx = xy_base[i, 0] - sensor_xy_m[0]
        by = xy_base[i, 1] - sensor_xy_m[1]
        range_m = math.sqrt(bx * bx + by * by)
        cosine = np.float32(0.0)
        if range_m > 0.0:
            cosine = np.float32(-(normals[i, 0] * bx + normals[i, 1] * by) / range_m)
        for k in range(LASERS):
            of_laser = cosine if k == laser else np.float32(0.0)
            surfels[slot, r, q, side, COSINES + k] += (
                of_laser - surfels[slot, r, q, side, COSINES + k]
            ) * share


@inner_kernel
def clear_fine_cells(fine_grid, row, column):
    """Clear the surfels of the PARTS x PARTS finer cells within a full cell."""
    slots = fine_grid.tiles.slots
    first_row = fine_grid.tiles.origin[0]
    first_column = fine_grid.tiles.origin[1]
    for v in range(PARTS * row, PARTS * row + PARTS):
        for u in range(PARTS * column, PARTS * column + PARTS):
            slot = slot_at(slots, (v >> TILE_BITS) - first_row, (u >> TILE_BITS) - first_column)
            if slot != NO_TILE:
                fine_grid.surfels[slot, v & TILE_MASK, u & TILE_MASK] = np.float32(0.0)


@kernel(SurfelGrid, int, float)
def shorten_surfels(grid, laser, step_m):
    """Move the walls of a sub-map by a change of a laser's constant range bias.

    grid     SurfelGrid   in and out; with cosines
    laser    int          below LASERS
    step_m   float
    """
    surfels = grid.surfels
    slots = grid.tiles.slots
    for tile_row in range(slots.shape[0]):
        for tile_column in range(slots.shape[1]):
            slot = slots[tile_row, tile_column]
            if slot == NO_TILE:
                continue
            for r in range(TILE_CELLS):
                for q in range(TILE_CELLS):
                    for side in range(2):
                        if surfels[slot, r, q, side, COUNT] == 0.0:
                            break  # sides are filled in order
                        forward_m = np.float32(step_m * surfels[slot, r, q, side, COSINES + laser])
                        surfels[slot, r, q, side, MEAN_X] += forward_m * surfels[slot, r, q, side, NORMAL_X]
                        surfels[slot, r, q, side, MEAN_Y] += forward_m * surfels[slot, r, q, side, NORMAL_Y]


@inner_kernel
def find_surfels(xy_base, normals, pose, grid, least_cosine, found):
    """The wall beside each point, without a cache; see find_surfels_cached."""
    cache = empty_cache(xy_base.shape[0])
    find_surfels_cached(xy_base, normals, pose, grid, least_cosine, 0.0, cache, found)


@inlined_kernel
def gather_surfels(grid, row, column, near_surfels, first):
    """Copy the surfels of the 3 x 3 cells around a cell, with means from the centre of that cell.

    near_surfels   (M, 5) float64   out: rows from `first` on, as in SurfelCache
    Returns the row after the last one. Cells are read as scalars: a reference costs more than a surfel.
    """
    surfels = grid.surfels
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    end = first
    last_row = last_column = NO_ROW
    slot = NO_TILE
    for v in range(-1, 2):
        tile_row = ((row + v) >> TILE_BITS) - first_row
        r = (row + v) & TILE_MASK
        for u in range(-1, 2):
            tile_column = ((column + u) >> TILE_BITS) - first_column
            if tile_row != last_row or tile_column != last_column:
                last_row = tile_row
                last_column = tile_column
                slot = slot_at(slots, tile_row, tile_column)
            if slot == NO_TILE:
                continue
            q = (column + u) & TILE_MASK
            for side in range(2):
                n = surfels[slot, r, q, side, COUNT]
                if n == 0.0:
                    break  # sides are filled in order
                near_surfels[end, COUNT] = n
                near_surfels[end, MEAN_X] = u * grid.cell_m + surfels[slot, r, q, side, MEAN_X]
                near_surfels[end, MEAN_Y] = v * grid.cell_m + surfels[slot, r, q, side, MEAN_Y]
                near_surfels[end, NORMAL_X] = surfels[slot, r, q, side, NORMAL_X]
                near_surfels[end, NORMAL_Y] = surfels[slot, r, q, side, NORMAL_Y]
                end += 1
    return end


@inlined_kernel
def wall_beside(near_surfels, first, end, dx, dy, nx, ny, per_square_reach, least_cosine):
    """Weighted mean of the surfels of rows first to end around a point.

    dx, dy             m, of the point from the centre of its cell
    nx, ny             its normal
    per_square_reach   1/m^2
    Returns (x m, y m of the wall from the centre of the cell, normal x, normal y, points it stands for).
    A round wall lies between the plane through the mean and the surfels' own planes, at ROUND_SHARE; [28].
    """
    total = sum_x = sum_y = sum_nx = sum_ny = sum_off = 0.0
    for k in range(first, end):
        mx = near_surfels[k, MEAN_X]
        my = near_surfels[k, MEAN_Y]
        sx = near_surfels[k, NORMAL_X]
        sy = near_surfels[k, NORMAL_Y]
        # Weights of 0 instead of branches, which no processor predicts here.
        near = max(1.0 - ((mx - dx) * (mx - dx) + (my - dy) * (my - dy)) * per_square_reach, 0.0)
        count = near_surfels[k, COUNT] if sx * nx + sy * ny > least_cosine else 0.0
        weight = count * near * near
        total += weight
        sum_x += weight * mx
        sum_y += weight * my
        sum_nx += weight * sx
        sum_ny += weight * sy
        sum_off += weight * (sx * (dx - mx) + sy * (dy - my))
    length = math.sqrt(sum_nx * sum_nx + sum_ny * sum_ny)
    if length == 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    nx = sum_nx / length
    ny = sum_ny / length
    off_mean = nx * (dx - sum_x / total) + ny * (dy - sum_y / total)  # distance from the mean plane
    behind = ROUND_SHARE * (sum_off / total - off_mean)
    return sum_x / total - behind * nx, sum_y / total - behind * ny, nx, ny, total


@inner_kernel
def find_surfels_cached(xy_base, normals, pose, grid, least_cosine, least_count, cache, found):
    """The wall beside each point: mean of the surfels in the 3 x 3 cells around it with a similar normal.

    A cell cuts the noise of a wall at its border, so its surfel alone is biased where a border runs along the
    wall. The mean over surfels, weighted by count and distance, is not.

    xy_base        (N, 2) float64   m, base frame
    normals        (N, 3) float64   from estimate_normals; points of weight 0 get none
    pose           (3,)   float64   base in the frame of the grid
    grid           SurfelGrid
    least_cosine   float            between the two normals; -2 accepts any
    least_count    float            walls that stand for fewer points are ignored
    cache          SurfelCache      in and out: from empty_cache or the previous search
    found          (N, 6) float64   out: x, y of the wall (m, frame of the grid), normal x, normal y, points
                                    it stands for, 0: none, the rest is then undefined; consecutive points of
                                    this scan in the same cell
    Source: moving least squares, Kolluri 2008; for scans, Deschaud, IMLS-SLAM, 2018, eq. (1); of second
    order by the normals, as the spheres of Guennebaud, Gross, Algebraic point set surfaces, 2007.
    """
    # The surfels around a cell are gathered once for consecutive points.
    near_cell, near_span, near_surfels = cache.cell, cache.span, cache.surfels
    used = cache.used[0]
    first = end = 0
    cell_m = grid.cell_m
    cells_per_m = 1.0 / cell_m
    per_square_reach = 1.0 / (REACH_CELLS * cell_m) ** 2
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    run = 0  # first of consecutive points in one cell
    run_row = run_column = NO_ROW
    for i in range(xy_base.shape[0]):
        found[i, 4] = 0.0
        if normals[i, 2] == 0.0:
            continue
        x = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        y = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
        nx = c * normals[i, 0] - s * normals[i, 1]
        ny = s * normals[i, 0] + c * normals[i, 1]
        column = math.floor(x * cells_per_m)
        row = math.floor(y * cells_per_m)
        if row != run_row or column != run_column:
            for k in range(run, i):
                found[k, 5] = i - run
            run = i
            run_row = row
            run_column = column
            if near_cell[i, 0] == row and near_cell[i, 1] == column:
                first = near_span[i, 0]
                end = first + near_span[i, 1]
            else:
                if used + SURFELS_AROUND > near_surfels.shape[0]:  # full
                    clear_cache(cache)
                    used = 0
                first = used
                used = end = gather_surfels(grid, row, column, near_surfels, first)
                near_cell[i, 0] = row
                near_cell[i, 1] = column
                near_span[i, 0] = first
                near_span[i, 1] = end - first
        centre_x, centre_y = (column + 0.5) * cell_m, (row + 0.5) * cell_m
        wall_x, wall_y, nx, ny, total = wall_beside(
            near_surfels, first, end, x - centre_x, y - centre_y, nx, ny, per_square_reach, least_cosine
        )
        if total > 0.0 and total >= least_count:
            found[i, 0] = wall_x + centre_x
            found[i, 1] = wall_y + centre_y
            found[i, 2] = nx
            found[i, 3] = ny
            found[i, 4] = total
    for k in range(run, xy_base.shape[0]):
        found[k, 5] = xy_base.shape[0] - run
    cache.used[0] = used
