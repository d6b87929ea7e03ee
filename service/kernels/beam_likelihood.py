"""Log-likelihood ratio of the beams of a scan at a pose in a known map, against unknown ground.

A beam is likely where it ends on a wall of the map, and unlikely in known free space or behind a wall. Each
wall that beams pass through counts once, however many do so: one removed object is one event.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.compile.lazy import njit
from service.kernels.arrays import Bool_2D, Float32_4D, Float64_1D, Float64_2D, Int32_3D, UInt8_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.occupancy import OccupancyGrid, evidence_at
from service.kernels.rays import BEHIND_M, begin_ray, next_cell
from service.kernels.surfels import (
    COUNT,
    MEAN_X,
    MEAN_Y,
    MIN_NORMAL_COSINE,
    NORMAL_X,
    NORMAL_Y,
    TILE_BITS,
    TILE_CELLS,
    TILE_MASK,
    SurfelGrid,
    find_surfels,
)
from service.kernels.tiles import NO_TILE, find_tile

WALL_SIGMA_M = 0.02  # of a point off its wall: noise of the range, of the map and of the pose
POINT_CELL_M, POINT_SIGMA_M, POINT_REACH = 0.05, 0.04, 2  # of end points without a normal, kept in a grid
# Densities of the end of a beam, 1/m: in known free space, by people, chairs and doors; on unknown ground,
# where surfaces are smooth: a beam ends within 0.1 m (1 sigma) of its neighbour.
FREE_DENSITY, UNKNOWN_DENSITY = 0.01, 4.0
ON_WALL, ON_POINT = 0.8, 0.2  # shares of the beams that end on mapped surfaces
AT_BACK, BACK_M, BACK_SIGMA_M = 1.5, 0.1, 0.03  # back of a wall: share, thickness of the wall, its sigma
THROUGH_REACH_M = 0.07  # half length of a surfel in the test whether a beam passes through it
MIN_REMOVED_PROBABILITY = 0.02  # least probability that a wall was removed
MAX_LOG_RATIO = 1.5  # nats: mean of beams that all end on walls
MIN_LOG_RATIO = 0.5 * math.log(FREE_DENSITY / UNKNOWN_DENSITY)  # nats: a beam below it contradicts the map


class KnownGround(NamedTuple):
    """A map prepared for evaluating beams.

    walls     SurfelGrid
    has_wall  (H, W) bool                   whether a cell of `walls` has a surfel, from its first tile on
    through_count (capacity, T, T, 2) float32   beams of the map's own scans through each surfel
    ground    OccupancyGrid                 with cells of the size of those of `walls`
    free      int                           a cell with at most this evidence is free
    points    (H, W) uint8                  likelihood of an end point near those of the map, cells of
                                            POINT_CELL_M, by splat_points
    first_row, first_column   int           of the cell of the map that is points[0, 0]
    visited   (capacity, T, T) int32        number of the last pose with beams through a cell of `walls`
    """

    walls: SurfelGrid
    has_wall: Bool_2D
    through_count: Float32_4D
    ground: OccupancyGrid
    free: int
    points: UInt8_2D
    first_row: int
    first_column: int
    visited: Int32_3D


@njit(cache=True, nogil=True, inline="always")
def passes_through(surfels, slot, row, column, side, u, v, du, dv):
    """Whether a beam passes through a surfel, from either side, and ends at least BEHIND_M behind it.

    u, v     float   start of the beam, m from the centre of the cell
    du, dv   float   from there to its end point, m
    """
    nx = np.float64(surfels[slot, row, column, side, NORMAL_X])
    ny = np.float64(surfels[slot, row, column, side, NORMAL_Y])
    mx = np.float64(surfels[slot, row, column, side, MEAN_X])
    my = np.float64(surfels[slot, row, column, side, MEAN_Y])
    before_m = nx * (u - mx) + ny * (v - my)
    after_m = before_m + nx * du + ny * dv
    if before_m * after_m >= 0.0 or abs(after_m) < BEHIND_M:
        return False
    share = before_m / (before_m - after_m)
    x = u + share * du - mx
    y = v + share * dv - my
    return x * x + y * y < THROUGH_REACH_M * THROUGH_REACH_M


@kernel(Float64_2D, Float64_1D, SurfelGrid, float, Float32_4D)
def count_beams_through(ends, sensor, walls, weight, through_count):
    """Count the beams of one scan that pass through each surfel.

    ends     (N, 2) float64   m, frame of the map
    sensor   (2,)   float64   start of the beams
    walls    SurfelGrid
    weight   float            of each beam
    through_count   (capacity, T, T, 2) float32   in and out
    """
    cell_m = walls.cell_m
    for i in range(ends.shape[0]):
        du, dv = ends[i, 0] - sensor[0], ends[i, 1] - sensor[1]
        column, row, step_column, step_row, next_column, next_row, per_column, per_row, steps = begin_ray(
            sensor[0] / cell_m, sensor[1] / cell_m, du / cell_m, dv / cell_m
        )
        for _ in range(steps):
            slot = find_tile(walls.tiles, row >> TILE_BITS, column >> TILE_BITS)
            if slot != NO_TILE:
                r, q = row & TILE_MASK, column & TILE_MASK
                u = sensor[0] - (column + 0.5) * cell_m
                v = sensor[1] - (row + 0.5) * cell_m
                for side in range(2):
                    if walls.surfels[slot, r, q, side, COUNT] == 0.0:
                        break  # sides are filled in order
                    if passes_through(walls.surfels, slot, r, q, side, u, v, du, dv):
                        through_count[slot, r, q, side] += np.float32(weight)
            column, row, next_column, next_row = next_cell(
                column, row, step_column, step_row, next_column, next_row, per_column, per_row
            )


def cells_with_walls(walls: SurfelGrid) -> npt.NDArray[np.bool_]:
    """`has_wall` of a KnownGround: one byte a cell instead of forty."""
    rows, columns = walls.tiles.slots.shape
    has_wall = np.zeros((rows, TILE_CELLS, columns, TILE_CELLS), np.bool_)
    for row, column in np.argwhere(walls.tiles.slots != NO_TILE).tolist():
        surfels = walls.surfels[walls.tiles.slots[row, column]]
        has_wall[row, :, column, :] = surfels[:, :, 0, COUNT] > 0.0  # sides are filled in order
    return has_wall.reshape(rows * TILE_CELLS, columns * TILE_CELLS)


@kernel(Float64_2D, int, int, UInt8_2D)
def splat_points(xy, first_row, first_column, points):
    """Raise the likelihood of an end point around each point, to 255 at the point itself.

    xy       (N, 2) float64   m, no nearer than POINT_REACH cells to the border
    points   (H, W) uint8     in and out, cells of POINT_CELL_M
    """
    scale = -0.5 / (POINT_SIGMA_M * POINT_SIGMA_M)
    for i in range(xy.shape[0]):
        column, row = math.floor(xy[i, 0] / POINT_CELL_M), math.floor(xy[i, 1] / POINT_CELL_M)
        if points[row - first_row, column - first_column] > 250:
            continue  # another point is at the centre of the cell
        for r in range(row - POINT_REACH, row + POINT_REACH + 1):
            dy = (r + 0.5) * POINT_CELL_M - xy[i, 1]
            for q in range(column - POINT_REACH, column + POINT_REACH + 1):
                dx = (q + 0.5) * POINT_CELL_M - xy[i, 0]
                value = np.uint8(255.0 * math.exp(scale * (dx * dx + dy * dy)))
                at = r - first_row, q - first_column
                points[at] = max(points[at], value)


@inner_kernel
def log_removed_probability(u, v, du, dv, known, number):
    """Log-probability that the walls along a beam were removed; walls counted for this pose are skipped.

    u, v     float   start, m, frame of the map
    du, dv   float   from there to its end
    number   int     of the pose
    """
    walls, through_count, has_wall = known.walls, known.through_count, known.has_wall
    cell_m = walls.cell_m
    first_row, first_column = (
        walls.tiles.origin[0] << TILE_BITS,
        walls.tiles.origin[1] << TILE_BITS,
    )
    column, row, step_column, step_row, next_column, next_row, per_column, per_row, steps = begin_ray(
        u / cell_m, v / cell_m, du / cell_m, dv / cell_m
    )
    total = 0.0
    for _ in range(steps):
        i, j = row - first_row, column - first_column
        if 0 <= i < has_wall.shape[0] and 0 <= j < has_wall.shape[1] and has_wall[i, j]:
            slot = find_tile(walls.tiles, row >> TILE_BITS, column >> TILE_BITS)
            r, q = row & TILE_MASK, column & TILE_MASK
            if known.visited[slot, r, q] != number:
                removed_share = 1.0
                for side in range(2):
                    hits = walls.surfels[slot, r, q, side, COUNT]
                    if hits == 0.0:
                        break
                    if passes_through(
                        walls.surfels,
                        slot,
                        r,
                        q,
                        side,
                        u - (column + 0.5) * cell_m,
                        v - (row + 0.5) * cell_m,
                        du,
                        dv,
                    ):
                        through = through_count[slot, r, q, side]
                        removed_share = min(removed_share, (through + 0.5) / (hits + through + 1.0))
                if removed_share < 1.0:
                    known.visited[slot, r, q] = number
                    total += math.log(max(removed_share, MIN_REMOVED_PROBABILITY))
        column, row, next_column, next_row = next_cell(
            column, row, step_column, step_row, next_column, next_row, per_column, per_row
        )
    return total


@inner_kernel
def background_density(ground, free, x, y):
    """Density of beams that end off the walls of the map, 1/m; in free space its 3 x 3 cells are free."""
    column, row = math.floor(x / ground.cell_m), math.floor(y / ground.cell_m)
    for r in range(row - 1, row + 2):
        for q in range(column - 1, column + 2):
            evidence = evidence_at(ground, r, q)
            if evidence == 0 or evidence > free:
                return UNKNOWN_DENSITY
    return FREE_DENSITY


@inner_kernel
def weigh_ends(xy, normals, pose, known, at_end):
    """Log-likelihood ratio of the end of each beam at a pose, against unknown ground.

    xy        (N, 2) float64   ends of the beams, m
    normals   (N, 3) float64   of the walls there
    pose      (3,)   float64   of their frame in the map
    known     KnownGround
    at_end    (N,)   float64   out, nats: about MAX_LOG_RATIO on a wall, 0 on unknown ground, negative in free
    space Source: Thrun, Burgard, Fox, Probabilistic Robotics, section 6.3 (beam model).
    """
    count = xy.shape[0]
    front, back, turned = np.empty((count, 6)), np.empty((count, 6)), normals.copy()
    turned[:, :2] *= -1.0
    find_surfels(xy, normals, pose, known.walls, MIN_NORMAL_COSINE, front)
    find_surfels(xy, turned, pose, known.walls, MIN_NORMAL_COSINE, back)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    on_wall = ON_WALL / (math.sqrt(2.0 * math.pi) * WALL_SIGMA_M)
    on_point = ON_POINT / (math.sqrt(2.0 * math.pi) * POINT_SIGMA_M * 255.0)
    for i in range(count):
        x = pose[0] + c * xy[i, 0] - s * xy[i, 1]
        y = pose[1] + s * xy[i, 0] + c * xy[i, 1]
        density = background_density(known.ground, known.free, x, y)
        if front[i, 4] > 0.0:
            off_m = (x - front[i, 0]) * front[i, 2] + (y - front[i, 1]) * front[i, 3]
            density += on_wall * math.exp(-0.5 * (off_m / WALL_SIGMA_M) ** 2)
        if back[i, 4] > 0.0:
            behind_m = -((x - back[i, 0]) * back[i, 2] + (y - back[i, 1]) * back[i, 3])
            off_m = max(0.0, behind_m - BACK_M, -behind_m)
            density += AT_BACK * math.exp(-0.5 * (off_m / BACK_SIGMA_M) ** 2)
        row = math.floor(y / POINT_CELL_M) - known.first_row
        column = math.floor(x / POINT_CELL_M) - known.first_column
        if 0 <= row < known.points.shape[0] and 0 <= column < known.points.shape[1]:
            density += on_point * known.points[row, column]
        at_end[i] = math.log(density / UNKNOWN_DENSITY)


@inner_kernel
def weigh_paths(xy, sensors, pose, known, number, least, along_beam):
    """Log-probability that the walls along each beam were removed; stops once the sum is below `least`.

    xy        (N, 2) float64   ends of the beams, m
    sensors   (N, 2) float64   their starts, m, in the frame of xy
    pose      (3,)   float64   of that frame in the map
    known     KnownGround      its pose numbers are updated
    number    int              of this pose; unlike that of the call before
    least     float            nats
    along_beam (N,)  float64   out, nats, 0 or less; 0 for beams not evaluated
    Returns the sum.
    Source: hits and misses of a surfel, as in reflection maps (Haehnel 2004).
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    along_beam[:] = 0.0
    total = 0.0
    for i in range(xy.shape[0]):
        x = pose[0] + c * xy[i, 0] - s * xy[i, 1]
        y = pose[1] + s * xy[i, 0] + c * xy[i, 1]
        u = pose[0] + c * sensors[i, 0] - s * sensors[i, 1]
        v = pose[1] + s * sensors[i, 0] + c * sensors[i, 1]
        along_beam[i] = log_removed_probability(u, v, x - u, y - v, known, number)
        total += along_beam[i]
        if total < least:
            break
    return total
