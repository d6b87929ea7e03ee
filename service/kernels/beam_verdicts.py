"""What a known map says to each beam of a scan at a pose: it ends on a wall, or contradicts the map."""

import math

import numpy as np
from numba import njit

from service.kernels.occupancy import evidence_at
from service.kernels.rays import begin_ray
from service.kernels.static_score import looks_through
from service.kernels.surfels import TILE_BITS, TILE_MASK, find_surfels
from service.kernels.tiles import NO_TILE, find_tile

NEW, ON_WALL, CLOSE, IN_FREE, THROUGH, BESIDE = range(6)
VERDICTS = 6
ON_WALL_M, CLOSE_M = 0.10, 0.03  # along the normal of the wall
LEAST_COSINE = 0.6  # between the normal of a point and that of its wall
THROUGH_REACH_M = 0.07  # how far from the middle of a surfel it still is the wall
BEHIND_M = 0.3  # a beam that ends so far behind a wall looks through it


@njit(cache=True, nogil=True)
def judge_beams(xy, normals, sensors, pose, walls, ground, free, verdict):
    """Count beams by what the map says to them.

    NEW       the end lies where the map knows nothing, and so it says nothing
    CLOSE     within CLOSE_M of a wall that faces the same way;  ON_WALL  within ON_WALL_M
    IN_FREE   where the map knows that nothing stands, in the cell and the eight around it
    THROUGH   behind a wall of the map, which the beam would have met
    BESIDE    else: near a wall, and not on it

    xy        (N, 2) float64   ends of the beams, m
    normals   (N, 3) float64   of the walls there
    sensors   (N, 2) float64   where each beam begins, m, in the frame of xy
    pose      (3,)   float64   of that frame in the map
    walls     SurfelGrid
    ground    OccupancyGrid    of cells as large as those of `walls`
    free      int              evidence at or below it: nothing stands in the cell
    verdict   (N,)   int64     out
    """
    found = np.empty((xy.shape[0], 6))
    find_surfels(xy, normals, pose, walls, LEAST_COSINE, found)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(xy.shape[0]):
        x = pose[0] + c * xy[i, 0] - s * xy[i, 1]
        y = pose[1] + s * xy[i, 0] + c * xy[i, 1]
        u = pose[0] + c * sensors[i, 0] - s * sensors[i, 1]
        v = pose[1] + s * sensors[i, 0] + c * sensors[i, 1]
        if passes_wall(u, v, x - u, y - v, walls, ground):
            verdict[i] = THROUGH
            continue
        if found[i, 4] > 0.0:
            off_m = abs((x - found[i, 0]) * found[i, 2] + (y - found[i, 1]) * found[i, 3])
            if off_m < ON_WALL_M:
                verdict[i] = CLOSE if off_m < CLOSE_M else ON_WALL
                continue
        column, row = math.floor(x / ground.cell_m), math.floor(y / ground.cell_m)
        is_known, is_free = False, True
        for r in range(row - 1, row + 2):
            for q in range(column - 1, column + 2):
                evidence = evidence_at(ground, r, q)
                is_known = is_known or evidence != 0
                is_free = is_free and evidence != 0 and evidence <= free
        verdict[i] = IN_FREE if is_free else BESIDE if is_known else NEW


@njit(cache=True, nogil=True)
def passes_wall(u, v, du, dv, walls, ground):
    """Whether a beam from (u, v) m by (du, dv) m meets a wall of the map before it ends. A wall that later
    beams of the map itself looked through, and so is none any more, does not count.
    """
    cell_m = walls.cell_m
    column, row, step_column, step_row, next_column, next_row, per_column, per_row, steps = begin_ray(
        u / cell_m, v / cell_m, du / cell_m, dv / cell_m
    )
    for _ in range(steps):
        slot = find_tile(walls.tiles, row >> TILE_BITS, column >> TILE_BITS)
        if (
            slot != NO_TILE
            and looks_through(
                walls.surfels,
                slot,
                row & TILE_MASK,
                column & TILE_MASK,
                THROUGH_REACH_M,
                u - (column + 0.5) * cell_m,
                v - (row + 0.5) * cell_m,
                du,
                dv,
                BEHIND_M,
            )
            and evidence_at(ground, row, column) > 0
        ):
            return True
        is_column = next_column < next_row
        column += step_column if is_column else 0
        row += 0 if is_column else step_row
        next_column += per_column if is_column else 0.0
        next_row += 0.0 if is_column else per_row
    return False
