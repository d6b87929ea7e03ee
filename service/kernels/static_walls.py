"""Scans compared with a sub-map by static scores: returns in free space, beams through walls, residuals."""

import math

import numpy as np

from service.kernels.arrays import Bool_1D, Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.rays import begin_ray, next_cell
from service.kernels.static_score import (
    ENTERED_FREE,
    Observations,
    max_score_around,
    passes_from_front,
    placed,
    score_at,
    slot_of,
)
from service.kernels.surfels import (
    NORMAL_X,
    NORMAL_Y,
    TILE_MASK,
    SurfelGrid,
    find_surfels,
    side_of,
)
from service.kernels.tiles import NO_TILE


@inner_kernel
def exists_since(slots, first_row, first_column, observations, row, column, side, latest):
    """Whether a surfel of a cell exists since a path mark or before; slots as in slot_of."""
    slot = slot_of(slots, first_row, first_column, row, column)
    if slot == NO_TILE:
        return False
    r = row & TILE_MASK
    q = column & TILE_MASK
    return (
        observations.score[slot, r, q] > 0 and observations.since[slot, r, q, side] % ENTERED_FREE <= latest
    )


@inner_kernel
def any_exists_since(slots, first_row, first_column, observations, row, column, latest):
    """Whether any of the 3 x 3 cells around a cell has such a surfel."""
    for r in range(row - 1, row + 2):
        for q in range(column - 1, column + 2):
            if exists_since(slots, first_row, first_column, observations, r, q, 0, latest):
                return True
    return False


@inner_kernel
def was_free_behind(x, y, normal, c, s, grid, observations):
    """Whether the cell behind a point was free before; without a normal, all 3 x 3 cells around the point.

    Where a wall comes into view at grazing incidence, beams passed through part of its cells, not behind it.

    x, y     float           the point, m, frame of the grid
    normal   (3,)  float64   of the point, from estimate_normals, base frame
    c, s     float           cosine and sine of the heading of the base in the frame of the grid
    """
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    u = x / grid.cell_m
    v = y / grid.cell_m
    reach = 1
    if normal[2] > 0.0:
        u -= c * normal[0] - s * normal[1]
        v -= s * normal[0] + c * normal[1]
        reach = 0
    row = math.floor(v)
    column = math.floor(u)
    for r in range(row - reach, row + reach + 1):
        for q in range(column - reach, column + reach + 1):
            slot = slot_of(slots, first_row, first_column, r, q)
            if slot == NO_TILE or observations.since[slot, r & TILE_MASK, q & TILE_MASK, 0] < ENTERED_FREE:
                return False
    return True


@inner_kernel
def passes_wall_since(x, y, dx, dy, grid, observations, latest, behind_m):
    """Whether a beam passes through a wall that exists since a path mark or before.

    x, y     float   start of the beam, m, frame of the grid
    dx, dy   float   from there to its end point, m
    latest   int     mark; ENTERED_FREE: all walls
    """
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cell_m = grid.cell_m
    cells_per_m = 1.0 / cell_m
    column, row, step_column, step_row, next_column, next_row, per_column, per_row, steps = begin_ray(
        x * cells_per_m, y * cells_per_m, dx * cells_per_m, dy * cells_per_m
    )
    for _ in range(steps):
        if exists_since(slots, first_row, first_column, observations, row, column, 0, latest):
            slot = slot_of(slots, first_row, first_column, row, column)
            u = x - (column + 0.5) * cell_m
            v = y - (row + 0.5) * cell_m
            if passes_from_front(
                grid.surfels, slot, row & TILE_MASK, column & TILE_MASK, 0.5 * cell_m, u, v, dx, dy, behind_m
            ):
                return True
        column, row, next_column, next_row = next_cell(
            column, row, step_column, step_row, next_column, next_row, per_column, per_row
        )
    return False


@kernel(Float64_2D, Float64_1D, Float64_2D, Float64_1D, SurfelGrid, Observations, float)
def count_contradicting(xy_base, sensor_xy_m, normals, pose, grid, observations, behind_m):
    """Number of points in free space, and of points behind a wall on unknown ground.

    xy_base       (N, 2) float64   m, base frame
    sensor_xy_m   (2,)   float64   start of the beams, m, base frame
    normals       (N, 3) float64   from estimate_normals; points of weight 0 are skipped
    pose          (3,)   float64   base in the frame of the grid
    grid          SurfelGrid
    observations  Observations
    behind_m      float            as in passes_from_front
    Returns (in free space, behind a wall). Points with an occupied cell in their 3 x 3 cells are in neither;
    in free space are those of which was_free_behind is true.
    """
    score = observations.score
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cells_per_m = 1.0 / grid.cell_m
    xy = placed(xy_base, pose)
    x, y = placed(sensor_xy_m.reshape(1, 2), pose)[0]
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    in_free = 0
    behind = 0
    for i in range(xy_base.shape[0]):
        if normals[i, 2] == 0.0:
            continue
        dx = xy[i, 0] - x
        dy = xy[i, 1] - y
        column = math.floor((x + dx) * cells_per_m)
        row = math.floor((y + dy) * cells_per_m)
        if max_score_around(slots, first_row, first_column, score, row, column) > 0:
            continue
        if score_at(slots, first_row, first_column, score, row, column) < 0:
            in_free += was_free_behind(xy[i, 0], xy[i, 1], normals[i], c, s, grid, observations)
            continue
        behind += passes_wall_since(x, y, dx, dy, grid, observations, np.int64(ENTERED_FREE), behind_m)
    return in_free, behind


@kernel(Float64_2D, Float64_2D, Float64_1D, SurfelGrid, Observations, float, int, int, Float64_1D)
def static_residuals(
    xy_base, normals, pose, grid, observations, least_cosine, latest, latest_arrived, residual_m
):
    """Distances of points from walls that exist since a path mark or before.

    Arguments as in count_contradicting, and

    least_cosine  float            as in find_surfels
    latest        int              mark
    latest_arrived int             the same, of walls in cells that were free before
    residual_m    (N,)   float64   out: along the wall's normal; NaN without such a wall
    """
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cells_per_m = 1.0 / grid.cell_m
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    xy = placed(xy_base, pose)
    found = np.empty((xy_base.shape[0], 6))
    find_surfels(xy_base, normals, pose, grid, least_cosine, found)
    for i in range(xy_base.shape[0]):
        residual_m[i] = math.nan
        if normals[i, 2] == 0.0 or found[i, 4] == 0.0:
            continue
        row = math.floor(xy[i, 1] * cells_per_m)
        column = math.floor(xy[i, 0] * cells_per_m)
        nx = np.float32(c * normals[i, 0] - s * normals[i, 1])
        ny = np.float32(s * normals[i, 0] + c * normals[i, 1])
        # An object that came recently into the cell of a wall, or beside it, is not the wall.
        reach = 0 if score_at(slots, first_row, first_column, observations.score, row, column) > 0 else 1
        is_static = False
        for r in range(row - reach, row + reach + 1):
            for q in range(column - reach, column + reach + 1):
                slot = slot_of(slots, first_row, first_column, r, q)
                if slot == NO_TILE or is_static:
                    continue
                v = r & TILE_MASK
                u = q & TILE_MASK
                side = side_of(grid.surfels, slot, v, u, nx, ny)
                cosine = grid.surfels[slot, v, u, side, NORMAL_X] * nx
                cosine += grid.surfels[slot, v, u, side, NORMAL_Y] * ny
                if cosine >= least_cosine:
                    mark = latest_arrived if observations.since[slot, v, u, side] >= ENTERED_FREE else latest
                    is_static = exists_since(slots, first_row, first_column, observations, r, q, side, mark)
        if is_static:
            residual_m[i] = found[i, 2] * (xy[i, 0] - found[i, 0]) + found[i, 3] * (xy[i, 1] - found[i, 1])


@kernel(Float64_2D, Float64_2D, Float64_1D, SurfelGrid, Observations, int, Bool_1D)
def find_dynamic(xy_base, normals, pose, grid, observations, latest, is_dynamic):
    """Mark points on dynamic objects: in free space, or in cells occupied only recently.

    Arguments as in count_contradicting, and

    latest       int         path mark; cells occupied later are recent
    is_dynamic   (N,) bool   out; False beside an older wall, and where was_free_behind is
    """
    slots = grid.tiles.slots
    first_row = grid.tiles.origin[0]
    first_column = grid.tiles.origin[1]
    cells_per_m = 1.0 / grid.cell_m
    xy = placed(xy_base, pose)
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    for i in range(xy_base.shape[0]):
        is_dynamic[i] = False
        row = math.floor(xy[i, 1] * cells_per_m)
        column = math.floor(xy[i, 0] * cells_per_m)
        slot = slot_of(slots, first_row, first_column, row, column)
        if slot == NO_TILE:
            continue
        score = observations.score[slot, row & TILE_MASK, column & TILE_MASK]
        since = observations.since[slot, row & TILE_MASK, column & TILE_MASK, 0]
        if score < 0 or (score > 0 and since >= ENTERED_FREE):
            is_dynamic[i] = not any_exists_since(
                slots, first_row, first_column, observations, row, column, latest
            ) and was_free_behind(xy[i, 0], xy[i, 1], normals[i], c, s, grid, observations)


@kernel(Float64_2D, Float64_1D, Float64_1D, SurfelGrid, Observations, int, float)
def count_beams_through_walls(xy_base, sensor_xy_m, pose, grid, observations, latest, behind_m):
    """Number of beams that pass through a wall that exists since a path mark or before.

    Arguments as in count_contradicting; latest: int, the mark.
    """
    xy = placed(xy_base, pose)
    x, y = placed(sensor_xy_m.reshape(1, 2), pose)[0]
    through = 0
    for i in range(xy_base.shape[0]):
        dx = xy[i, 0] - x
        dy = xy[i, 1] - y
        through += passes_wall_since(x, y, dx, dy, grid, observations, latest, behind_m)
    return through
