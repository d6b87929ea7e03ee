"""Global search of a scan in a large map: all positions and headings, by branch and bound.

A point of a wall matches only walls with a similar normal. A scan at a wrong heading therefore matches
nowhere, and most headings are pruned for entire blocks of the map.
"""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Bool_2D, Float64_2D, Int8_4D
from service.kernels.beam_likelihood import FREE_DENSITY, ON_WALL, UNKNOWN_DENSITY, WALL_SIGMA_M
from service.kernels.branch_and_bound import empty_stack, insert_part, push_block, push_parts
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.ordering import order_rising

DIRECTIONS = 16  # bins of normals; a wall counts in the two neighbouring bins, too
ANY = DIRECTIONS  # layer of points without a normal: posts, legs, leaves
LAYERS = DIRECTIONS + 1
SECTORS = 8  # of headings: a block keeps the best of each, as ambiguous poses differ by half turns
SUMMED_AT_ONCE = 8  # points, between two tests whether the rest can matter
NATS_STEP = 1.0 / 16.0  # resolution of the log-likelihood ratios of a pyramid


class FacingPyramid(NamedTuple):
    """Log-likelihood ratio of end points to unknown ground by the direction of their normals, and its maxima
    over blocks of cells.

    levels        (LAYERS, L, H, W) int8    in NATS_STEP; [d, l, r, c]: the maximum over 2^l x 2^l cells from
                                            (r, c) on; 0 on unknown ground
    first_row, first_column   int           cell of the map at levels[:, :, 0, 0]
    cell_m        float
    """

    levels: Int8_4D
    first_row: int
    first_column: int
    cell_m: float


@inner_kernel
def direction_of(angle_rad):
    """Bin of DIRECTIONS nearest to an angle."""
    return math.floor(angle_rad / (2.0 * math.pi) * DIRECTIONS + 0.5) % DIRECTIONS


@inner_kernel
def coarse_nats(likelihood, is_free):
    """Log-likelihood ratio of a beam that ends in a cell, in NATS_STEP: weigh_ends with blurred walls.

    likelihood   float   0..1, of the nearest wall; 1 at the wall
    """
    density = FREE_DENSITY if is_free else UNKNOWN_DENSITY
    density += likelihood * ON_WALL / (math.sqrt(2.0 * math.pi) * WALL_SIGMA_M)
    return np.int8(round(math.log(density / UNKNOWN_DENSITY) / NATS_STEP))


@kernel(Float64_2D, Float64_2D, Bool_2D, FacingPyramid, float)
def splat_facing(xy, normals, is_free, pyramid, sigma_m):
    """Fill all levels: of each cell by the nearest point in it or the cells beside.

    xy        (N, 2) float64   m, frame of the map; no nearer than a cell to the border of the pyramid
    normals   (N, 3) float64   of estimate_normals; weight 1 or more: a wall
    is_free   (H, W) bool      cells of level 0 that are entirely observed as free
    pyramid   FacingPyramid    out
    sigma_m   float            of the blur
    """
    levels, cell_m = pyramid.levels, pyramid.cell_m
    height, width = is_free.shape
    scale = -0.5 / (sigma_m * sigma_m)
    in_free = coarse_nats(0.0, True)
    for d in range(LAYERS):
        for r in range(height):
            for q in range(width):
                levels[d, 0, r, q] = in_free if is_free[r, q] else 0
    for i in range(xy.shape[0]):
        column = math.floor(xy[i, 0] / cell_m)
        row = math.floor(xy[i, 1] / cell_m)
        is_wall = normals[i, 2] >= 1.0
        own = direction_of(math.atan2(normals[i, 1], normals[i, 0])) if is_wall else 0
        for v in range(row - 1, row + 2):
            r = v - pyramid.first_row
            dy = max(v * cell_m - xy[i, 1], xy[i, 1] - (v + 1) * cell_m, 0.0)
            for u in range(column - 1, column + 2):
                q = u - pyramid.first_column
                dx = max(u * cell_m - xy[i, 0], xy[i, 0] - (u + 1) * cell_m, 0.0)
                nats = coarse_nats(math.exp(scale * (dx * dx + dy * dy)), is_free[r, q])
                levels[ANY, 0, r, q] = max(levels[ANY, 0, r, q], nats)
                if is_wall:
                    for beside in range(-1, 2):
                        d = (own + beside) % DIRECTIONS
                        levels[d, 0, r, q] = max(levels[d, 0, r, q], nats)
    for level in range(1, levels.shape[1]):
        half = 1 << (level - 1)
        for d in range(LAYERS):
            for r in range(height):
                below = min(r + half, height - 1)
                for q in range(width):
                    beside = min(q + half, width - 1)
                    levels[d, level, r, q] = max(
                        max(levels[d, level - 1, r, q], levels[d, level - 1, r, beside]),
                        max(levels[d, level - 1, below, q], levels[d, level - 1, below, beside]),
                    )


@inner_kernel
def facing_sum(cells, levels, level, row, column, least):
    """Sum of a level at points shifted by so many cells: an upper bound of every pose in the block. Once it
    can not reach `least` any more, a number below that.

    cells   (N, 3) int64   row, column, layer
    """
    count, height, width = cells.shape[0], levels.shape[2], levels.shape[3]
    on_wall = coarse_nats(1.0, False)
    total = 0
    for begin in range(0, count, SUMMED_AT_ONCE):
        end = min(begin + SUMMED_AT_ONCE, count)
        for n in range(begin, end):
            r = cells[n, 0] + row
            q = cells[n, 1] + column
            if 0 <= r < height and 0 <= q < width:
                total += levels[cells[n, 2], level, r, q]
        if total + on_wall * (count - end) < least:
            return least - 1
    return total


@inner_kernel
def turned_facing(xy_base, normals, theta_rad, cell_m, cells):
    """Row, column and layer (N, 3) of points at a heading, with the base at the centre of the cell (0, 0)."""
    c = math.cos(theta_rad) / cell_m
    s = math.sin(theta_rad) / cell_m
    for n in range(xy_base.shape[0]):
        cells[n, 0] = math.floor(0.5 + s * xy_base[n, 0] + c * xy_base[n, 1])
        cells[n, 1] = math.floor(0.5 + c * xy_base[n, 0] - s * xy_base[n, 1])
        cells[n, 2] = ANY
        if normals[n, 2] >= 1.0:
            cells[n, 2] = direction_of(math.atan2(normals[n, 1], normals[n, 0]) + theta_rad)


@inner_kernel
def search_block(cells, levels, stack, bound, row, column, least):
    """The best pose of one heading in a block of the highest level, above `least`, by branch and bound.

    cells   (N, 3) int64   of turned_facing
    bound   int            of the block
    Returns (sum, row, column, sums evaluated); row -1: none.
    """
    best, best_row, best_column, evaluated = least, -1, -1, 0
    depth = push_block(stack, 0, levels.shape[1] - 1, row, column, bound)
    while depth > 0:
        depth -= 1
        level, row, column = stack.blocks[depth, 0], stack.blocks[depth, 1], stack.blocks[depth, 2]
        if stack.bounds[depth] <= best:
            continue
        if level == 0:
            best, best_row, best_column = stack.bounds[depth], row, column
            continue
        half = 1 << (level - 1)
        parts = 0
        for r in (row, row + half):
            for q in (column, column + half):
                total = facing_sum(cells, levels, level - 1, r, q, best)
                parts = insert_part(stack, parts, total, r, q)
        evaluated += parts
        depth = push_parts(stack, depth, parts, level - 1, best + 1)
    return best, best_row, best_column, evaluated


@kernel(Float64_2D, Float64_2D, FacingPyramid, int, float)
def search_facing(xy_base, normals, pyramid, heading_count, least):
    """The best pose of each block of the map and sector of headings.

    xy_base         (N, 2) float64   m, base frame
    normals         (N, 3) float64
    pyramid         FacingPyramid    rows and columns: multiples of the blocks of its highest level
    heading_count   int              headings evaluated, a full turn
    least           float            nats, mean of the points: less likely poses are dropped
    Returns (poses (C, 4) float64: x m, y m, theta rad of the base in the frame of the map, nats, mean of the
    points; number of blocks evaluated).
    Source: Hess et al. 2016, Real-Time Loop Closure in 2D LIDAR SLAM, algorithm 3; here with layers of
    directions, and a best pose for each block.
    """
    levels = pyramid.levels
    count = xy_base.shape[0]
    top = levels.shape[1] - 1
    size = 1 << top
    rows, columns = levels.shape[2] // size, levels.shape[3] // size
    blocks = rows * columns
    unit = count / NATS_STEP
    floor = np.int64(math.floor(least * unit))

    cells = np.empty((heading_count, count, 3), np.int64)
    bounds = np.empty(heading_count * blocks, np.int64)
    promising = 0
    for place in range(bounds.size):
        k, block = place // blocks, place % blocks
        if block == 0:
            turned_facing(xy_base, normals, 2.0 * math.pi * k / heading_count, pyramid.cell_m, cells[k])
        row, column = block // columns * size, block % columns * size
        bounds[place] = facing_sum(cells[k], levels, top, row, column, floor)
        promising += bounds[place] > floor
    evaluated = bounds.size
    which = np.empty(promising, np.int64)
    falling = np.empty(promising)
    promising = 0
    for place in range(bounds.size):
        if bounds[place] > floor:
            which[promising] = place
            falling[promising] = -float(bounds[place])
            promising += 1
    order = np.empty(promising, np.int64)
    order_rising(falling, order)

    best = np.full(blocks * SECTORS, floor, np.int64)
    best_at = np.full((blocks * SECTORS, 3), -1, np.int64)  # heading, row, column
    stack = empty_stack(top, bounds)
    for n in order:
        place = which[n]
        k, block = place // blocks, place % blocks
        own = block * SECTORS + (k * SECTORS) // heading_count
        row, column = block // columns * size, block % columns * size
        total, row, column, more = search_block(
            cells[k], levels, stack, bounds[place], row, column, best[own]
        )
        evaluated += more
        if row >= 0:
            best[own] = total
            best_at[own, 0], best_at[own, 1], best_at[own, 2] = k, row, column
    kept = 0
    for own in range(best.size):
        kept += best_at[own, 0] >= 0
    places = np.empty((kept, 4))
    kept = 0
    for own in range(best.size):
        if best_at[own, 0] >= 0:
            places[kept, 0] = (pyramid.first_column + best_at[own, 2] + 0.5) * pyramid.cell_m
            places[kept, 1] = (pyramid.first_row + best_at[own, 1] + 0.5) * pyramid.cell_m
            places[kept, 2] = 2.0 * math.pi * best_at[own, 0] / heading_count
            places[kept, 3] = best[own] / unit
            kept += 1
    return places, evaluated
