"""Static score: how long each cell of a sub-map is occupied. Dynamic objects get low weights and are removed.

Time is counted in ticks; those of a key frame are the time since the previous one.
"""

import math
from typing import NamedTuple

import numpy as np

from service.compile.lazy import njit
from service.kernels.arrays import Float64_1D, Float64_2D, Int8_3D, UInt16_3D, UInt16_4D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.rays import begin_ray, next_cell
from service.kernels.surfels import (
    COUNT,
    MEAN_X,
    MEAN_Y,
    NORMAL_X,
    NORMAL_Y,
    TILE_BITS,
    TILE_MASK,
    SurfelGrid,
    clear_fine_cells,
    side_of,
    touch_tile,
)
from service.kernels.tiles import NO_TILE, slot_at

ENTERED_FREE = np.uint16(1 << 15)  # flag above all path marks


class Observations(NamedTuple):
    """Observations of key frames in the cells of a sub-map, in the slots of its surfels; 0: not observed.

    score     (capacity, T, T) int8     ticks; above 0: occupied, less the time in which beams passed through;
                                        below 0: free
    touched   (capacity, T, T) uint16   number of the key frame that observed the cell last
    since     (capacity, T, T, 2) uint16   path mark at which each of the cell's two surfels began, with the
                                        flag ENTERED_FREE if the cell was free before
    """

    score: Int8_3D
    touched: UInt16_3D
    since: UInt16_4D


class StaticScoreSettings(NamedTuple):
    """Documented in service/mapper/scan_match/submaps.py; times in ticks."""

    full_score: int
    max_free: int
    least_weight: float
    most_gain: float
    behind_m: float
    beam_step: int


@njit(cache=True, nogil=True, inline="always")  # called, it costs a reference to its surfels for each cell
def passes_from_front(surfels, slot, row, column, reach_m, u, v, du, dv, behind_m):
    """Whether a beam passes through a surfel of a cell from its front and ends at least behind_m behind it.

    A beam that grazes a wall ends on it or before it, and does not pass through.

    surfels       (capacity, T, T, 2, COLUMNS) float32
    slot, row, column   int     the cell, within its tile
    reach_m       float         half length of a surfel
    u, v          float         start of the beam, m from the centre of the cell
    du, dv        float         from there to its end point, m
    behind_m      float
    """
    for side in range(2):
        if surfels[slot, row, column, side, COUNT] == 0.0:
            break  # sides are filled in order
        nx = np.float64(surfels[slot, row, column, side, NORMAL_X])
        ny = np.float64(surfels[slot, row, column, side, NORMAL_Y])
        mx = np.float64(surfels[slot, row, column, side, MEAN_X])
        my = np.float64(surfels[slot, row, column, side, MEAN_Y])
        before_m = nx * (u - mx) + ny * (v - my)
        after_m = before_m + nx * du + ny * dv
        if before_m <= 0.0 or after_m > -behind_m:
            continue
        share = before_m / (before_m - after_m)
        x = u + share * du - mx
        y = v + share * dv - my
        if x * x + y * y < reach_m * reach_m:
            return True
    return False


@inner_kernel
def placed(xy_base, pose):
    """(N, 2) float64 m, points of the base frame in that of the grid; pose (3,): of the base."""
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    xy = np.empty((xy_base.shape[0], 2))
    for i in range(xy_base.shape[0]):
        xy[i, 0] = pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]
        xy[i, 1] = pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]
    return xy


@kernel(
    Float64_2D,
    Float64_2D,
    Float64_1D,
    SurfelGrid,
    Observations,
    StaticScoreSettings,
    np.uint16,
    int,
    np.uint16,
)
def count_hits(xy_base, normals, pose, grid, observations, settings, number, ticks, mark):
    """Count the cells with end points of a key frame; points in cells that were free until now get weight 0.

    xy_base     (N, 2) float64       m, base frame
    normals     (N, 3) float64       in and out: from estimate_normals
    pose        (3,)   float64       base in the frame of the grid
    grid        SurfelGrid           in and out; its index covers the points
    observations   Observations            in and out
    settings    StaticScoreSettings
    number      uint16               of the key frame; not that of the previous one, nor 0
    ticks       int                  since the previous one
    mark        uint16               path mark, see Observations.since
    """
    score = observations.score
    touched = observations.touched
    since = observations.since
    cells_per_m = 1.0 / grid.cell_m
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    xy = placed(xy_base, pose)
    tile_row = tile_column = -(2**62)
    slot = np.int64(NO_TILE)
    for i in range(xy_base.shape[0]):
        column = math.floor(xy[i, 0] * cells_per_m)
        row = math.floor(xy[i, 1] * cells_per_m)
        if row >> TILE_BITS != tile_row or column >> TILE_BITS != tile_column:
            tile_row = row >> TILE_BITS
            tile_column = column >> TILE_BITS
            slot = np.int64(touch_tile(grid, tile_row, tile_column))
        r = row & TILE_MASK
        q = column & TILE_MASK
        if touched[slot, r, q] != number:
            touched[slot, r, q] = number
            value = score[slot, r, q] + ticks
            if value > 0 and score[slot, r, q] <= 0:
                value = 1
                begun = mark + since[slot, r, q, 0] // ENTERED_FREE * ENTERED_FREE
                since[slot, r, q, 0] = since[slot, r, q, 1] = begun
            score[slot, r, q] = np.int8(min(value, settings.full_score))
        if score[slot, r, q] <= 0:
            normals[i, 2] = 0.0
            continue
        nx = np.float32(c * normals[i, 0] - s * normals[i, 1])
        ny = np.float32(s * normals[i, 0] + c * normals[i, 1])
        side = side_of(grid.surfels, slot, r, q, nx, ny)
        if side == 1 and grid.surfels[slot, r, q, 1, COUNT] == 0.0:
            since[slot, r, q, 1] = mark + since[slot, r, q, 0] // ENTERED_FREE * ENTERED_FREE


@kernel(
    Float64_2D,
    Float64_1D,
    Float64_1D,
    SurfelGrid,
    SurfelGrid,
    Observations,
    StaticScoreSettings,
    np.uint16,
    int,
)
def remove_by_ray_cast(xy_base, sensor_xy_m, pose, grid, fine_grid, observations, settings, number, ticks):
    """Remove surfels that beams of a key frame pass through, and mark free cells.

    Cells with an end point of the key frame are unchanged, and so are cells without a tile. Arguments as in
    count_hits, which is called first, and

    sensor_xy_m   (2,) float64   start of the beams, m, base frame
    fine_grid     SurfelGrid     in and out: of the same points, PARTS x PARTS cells for each of the grid
    """
    score = observations.score  # hoisted, as in find_surfels
    touched = observations.touched
    since = observations.since
    surfels = grid.surfels
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cell_m = grid.cell_m
    cells_per_m = 1.0 / cell_m
    xy = placed(xy_base, pose)
    x, y = placed(sensor_xy_m.reshape(1, 2), pose)[0]
    for i in range(number % settings.beam_step, xy_base.shape[0], settings.beam_step):
        dx = xy[i, 0] - x
        dy = xy[i, 1] - y
        range_m = math.hypot(dx, dy)
        if range_m <= settings.behind_m:
            continue
        reach = (range_m - settings.behind_m) / range_m * cells_per_m
        column, row, step_column, step_row, next_column, next_row, per_column, per_row, count = begin_ray(
            x * cells_per_m, y * cells_per_m, reach * dx, reach * dy
        )
        tile_row = tile_column = -(2**62)
        slot = NO_TILE
        for _ in range(count):
            if row >> TILE_BITS != tile_row or column >> TILE_BITS != tile_column:
                tile_row = row >> TILE_BITS
                tile_column = column >> TILE_BITS
                slot = slot_at(slots, tile_row - first_row, tile_column - first_column)
            r = row & TILE_MASK
            q = column & TILE_MASK
            if slot != NO_TILE and touched[slot, r, q] != number:
                value = np.int64(score[slot, r, q])
                if value <= 0:
                    touched[slot, r, q] = number
                    since[slot, r, q, 0] = ENTERED_FREE
                    score[slot, r, q] = np.int8(max(value - ticks, -settings.max_free))
                else:
                    u = x - (column + 0.5) * cell_m
                    v = y - (row + 0.5) * cell_m
                    if passes_from_front(surfels, slot, r, q, 0.5 * cell_m, u, v, dx, dy, settings.behind_m):
                        touched[slot, r, q] = number
                        score[slot, r, q] = np.int8(max(value - ticks, 0))
                        if score[slot, r, q] == 0:
                            since[slot, r, q, 0] = ENTERED_FREE
                            surfels[slot, r, q] = np.float32(0.0)
                            clear_fine_cells(fine_grid, row, column)
            column, row, next_column, next_row = next_cell(
                column, row, step_column, step_row, next_column, next_row, per_column, per_row
            )


@inner_kernel
def slot_of(slots, first_row, first_column, row, column):
    """Slot of a cell's tile, or NO_TILE; slots, first_row, first_column as in TileIndex."""
    return slot_at(slots, (row >> TILE_BITS) - first_row, (column >> TILE_BITS) - first_column)


@inner_kernel
def score_at(slots, first_row, first_column, score, row, column):
    """Score of a cell, 0 without a tile; slots as in slot_of."""
    slot = slot_of(slots, first_row, first_column, row, column)
    if slot == NO_TILE:
        return np.int64(0)
    return np.int64(score[slot, row & TILE_MASK, column & TILE_MASK])


@inner_kernel
def max_score_around(slots, first_row, first_column, score, row, column):
    """Largest score of the 3 x 3 cells around a cell."""
    most = score_at(slots, first_row, first_column, score, row, column)
    for r in range(row - 1, row + 2):
        for q in range(column - 1, column + 2):
            most = max(most, score_at(slots, first_row, first_column, score, r, q))
    return most


@kernel(Float64_2D, Float64_1D, SurfelGrid, Observations, StaticScoreSettings, Float64_2D)
def weigh_static_score(xy_base, pose, grid, observations, settings, normals):
    """Weigh points by the static score of their cells, relative to the highest of the scan.

    An unobserved cell takes the highest score of its neighbours: a prediction that is off by a cell puts
    points behind their wall. The weights are then scaled to their previous mean, at most by
    settings.most_gain: on new ground new objects count fully.

    xy_base     (N, 2) float64       m, base frame
    pose        (3,)   float64       base in the frame of the grid, as predicted
    grid        SurfelGrid
    observations   Observations
    settings    StaticScoreSettings
    normals     (N, 3) float64       in and out: weights from estimate_normals
    """
    score = observations.score
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cells_per_m = 1.0 / grid.cell_m
    xy = placed(xy_base, pose)
    count = xy_base.shape[0]
    occupied_ticks = np.zeros(count, np.int64)
    most_ticks = 1
    last_row = last_column = -(2**62)
    most = np.int64(0)
    for i in range(count):
        if normals[i, 2] == 0.0:
            continue
        column = math.floor(xy[i, 0] * cells_per_m)
        row = math.floor(xy[i, 1] * cells_per_m)
        if row != last_row or column != last_column:
            last_row = row
            last_column = column
            most = score_at(slots, first_row, first_column, score, row, column)
            if most == 0:
                most = max_score_around(slots, first_row, first_column, score, row, column)
        occupied_ticks[i] = max(most, np.int64(0))
        most_ticks = max(most_ticks, occupied_ticks[i])
    before = after = 0.0
    for i in range(count):
        weight = normals[i, 2]
        normals[i, 2] = weight * max(settings.least_weight, occupied_ticks[i] / most_ticks)
        if occupied_ticks[i] > 0:
            before += weight
            after += normals[i, 2]
    if after > 0.0:
        gain = min(before / after, settings.most_gain)
        for i in range(count):
            normals[i, 2] *= gain
