"""Branch and bound on a likelihood map: the result of an exhaustive search, with far fewer evaluations.

Rounding is monotonic: a bound, a float32 sum in the order of the points, is never below what it bounds.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.arrays import Float64_2D, LikelihoodCells
from service.kernels.compiled import inner_kernel, seldom_kernel
from service.kernels.likelihood_search import (
    LikelihoodLayer,
    SearchResult,
    SearchWindow,
    result_of,
    turned_cells,
)
from service.kernels.ordering import order_rising
from service.kernels.tiles import NO_TILE, find_tile


class BlockStack(NamedTuple):
    """Blocks of a pyramid that wait to be split, the best on top, and the parts of the one that is split.

    blocks        (4 L, 3) int64              level, row, column of its first cell
    bounds        (4 L,)   float32 or int64   upper bounds of the scores in them
    parts         (4, 2)   int64              row, column
    part_bounds   (4,)     as bounds          rising
    """

    blocks: npt.NDArray[np.int64]
    bounds: npt.NDArray[np.float32 | np.int64]
    parts: npt.NDArray[np.int64]
    part_bounds: npt.NDArray[np.float32 | np.int64]


class MaxPyramid(NamedTuple):
    """Max pyramid: cell (r, c) of level l is the maximum over 2^l x 2^l cells of the layer, towards +x, +y.

    levels           (L, H, W)  uint8 or float32, as the cells of the layer
    first_row, first_column   int   cell of the layer at levels[0, 0, 0]
    empty, offset, scale, cell_m    as in the layer
    """

    levels: LikelihoodCells
    first_row: int
    first_column: int
    empty: float
    offset: float
    scale: float
    cell_m: float


@seldom_kernel(LikelihoodLayer, int, int, LikelihoodCells)
def build_pyramid(layer, first_row, first_column, levels):
    """Fill a max pyramid from the part of a layer that begins at a cell.

    first_row, first_column   int   the cell of the layer at levels[0, 0, 0]; see padding_cells
    levels                    (L, H, W)  out, of the type of layer.cells
    Returns a MaxPyramid over `levels`. Cells outside it count as empty.
    Source: Hess et al. 2016, Real-Time Loop Closure in 2D LIDAR SLAM, section V.
    """
    height, width = levels.shape[1], levels.shape[2]
    tile_cells = layer.cells.shape[1]
    empty = np.full(1, layer.empty, levels.dtype)[0]
    for r in range(height):
        tile_row = (first_row + r) // tile_cells
        row = first_row + r - tile_row * tile_cells
        c = 0
        while c < width:
            tile_column = (first_column + c) // tile_cells
            column = first_column + c - tile_column * tile_cells
            run = min(tile_cells - column, width - c)
            slot = find_tile(layer.tiles, tile_row, tile_column)
            to = levels[0, r, c : c + run]
            if slot == NO_TILE:
                for n in range(run):
                    to[n] = empty
            else:
                of = layer.cells[slot, row, column : column + run]
                for n in range(run):
                    to[n] = of[n]
            c += run
    pool_levels(levels, layer.empty)
    return MaxPyramid(levels, first_row, first_column, layer.empty, layer.offset, layer.scale, layer.cell_m)


@seldom_kernel(LikelihoodCells, float)
def pool_levels(levels, empty):
    """Fill levels 1 and up from level 0; cells beyond the upper borders are `empty`."""
    height, width = levels.shape[1], levels.shape[2]
    outside = np.full(width, empty, levels.dtype)
    for level in range(1, levels.shape[0]):
        half = 1 << (level - 1)
        inner = max(width - half, 0)
        for r in range(height):
            near = levels[level - 1, r]
            far = levels[level - 1, r + half] if r + half < height else outside
            out = levels[level, r]
            near_next, far_next = near[width - inner :], far[width - inner :]
            for c in range(inner):
                out[c] = max(max(near[c], near_next[c]), max(far[c], far_next[c]))
            for c in range(inner, width):
                out[c] = max(max(near[c], far[c]), outside[c])


def padding_cells(level_count: int) -> int:
    """Empty cells that a pyramid needs below its first row and before its first column."""
    return (1 << (level_count - 1)) - 1


@inner_kernel
def block_sum(cells, counts, pyramid, level, shift_row, shift_column):
    """Sum of a level at shifted points: an upper bound of every candidate in the block.

    cells     (C, 2) int64     row and column in the layer, from turned_cells
    counts    (C,)   float32   points in each
    Returns float32, added up in the order of the points as add_block does.
    """
    field = pyramid.levels[level]
    height, width = field.shape
    empty = np.float32(pyramid.empty)
    shift_row = shift_row - pyramid.first_row
    shift_column = shift_column - pyramid.first_column
    total = np.float32(0.0)
    for n in range(cells.shape[0]):
        row = cells[n, 0] + shift_row
        column = cells[n, 1] + shift_column
        if 0 <= row < height and 0 <= column < width:
            total += counts[n] * np.float32(field[row, column])
        else:
            total += counts[n] * empty
    return total


@inner_kernel
def nearest_square(low, high):
    """Square of the number nearest to 0 in [low, high]."""
    if low > 0:
        return low * low
    return high * high if high < 0 else 0


@inner_kernel
def empty_stack(top, bounds):
    """A BlockStack for the blocks of levels up to `top`, of the type of bounds. At most 4 wait on a level."""
    return BlockStack(
        np.empty((4 * top + 4, 3), np.int64),
        np.empty(4 * top + 4, bounds.dtype),
        np.empty((4, 2), np.int64),
        np.empty(4, bounds.dtype),
    )


@inner_kernel
def insert_part(stack, count, bound, row, column):
    """Insert a part of the block that is split, by its bound, after `count` others. Returns their number."""
    at = count
    while at > 0 and stack.part_bounds[at - 1] > bound:
        stack.part_bounds[at] = stack.part_bounds[at - 1]
        stack.parts[at, 0] = stack.parts[at - 1, 0]
        stack.parts[at, 1] = stack.parts[at - 1, 1]
        at -= 1
    stack.part_bounds[at] = bound
    stack.parts[at, 0] = row
    stack.parts[at, 1] = column
    return count + 1


@inner_kernel
def push_block(stack, depth, level, row, column, bound):
    """Push a block on a stack of `depth` others. Returns their number."""
    stack.blocks[depth, 0] = level
    stack.blocks[depth, 1] = row
    stack.blocks[depth, 2] = column
    stack.bounds[depth] = bound
    return depth + 1


@inner_kernel
def push_parts(stack, depth, count, level, least):
    """Push those of `count` parts whose bound is `least` or more. Returns the depth of the stack."""
    for n in range(count):
        if stack.part_bounds[n] >= least:
            depth = push_block(
                stack, depth, level, stack.parts[n, 0], stack.parts[n, 1], stack.part_bounds[n]
            )
    return depth


@seldom_kernel(Float64_2D, MaxPyramid, SearchWindow, float)
def search_branch_and_bound(xy_base, pyramid, window, least_score):
    """The candidate of search_exhaustive on the layer of the pyramid, without evaluating most of them.

    xy_base       (N, 2) float64   m, base frame
    pyramid       MaxPyramid
    least_score   float            lower bound of the result; -inf: none
    Returns a SearchResult; with score -inf and the centre where nothing reaches least_score.
    Source: Hess et al. 2016, algorithm 3: depth first, the better half first; ties as in SearchResult.
    """
    half_x, half_y, half_theta = window.half_x, window.half_y, window.half_theta
    count = xy_base.shape[0]
    heading_count = 2 * half_theta + 1
    top = pyramid.levels.shape[0] - 1
    size = 1 << top
    rows = (2 * half_y) // size + 1
    columns = (2 * half_x) // size + 1

    cells = np.empty((heading_count, count, 2), np.int64)
    shares = np.empty((heading_count, count), np.float32)  # points in each
    counts = np.empty(heading_count, np.int64)
    bounds = np.empty(heading_count * rows * columns, np.float32)
    falling = np.empty(bounds.size)
    for n in range(bounds.size):
        k = n // (rows * columns)
        j, i = (n // columns) % rows * size, n % columns * size
        if j == 0 and i == 0:
            counts[k] = turned_cells(xy_base, window, k, pyramid.cell_m, cells[k], shares[k])
        own_cells, own_shares = cells[k, : counts[k]], shares[k, : counts[k]]
        bounds[n] = block_sum(own_cells, own_shares, pyramid, top, j - half_y, i - half_x)
        falling[n] = -bounds[n]
    order = np.empty(bounds.size, np.int64)
    order_rising(falling, order)
    evaluated = bounds.size

    best = np.float32((least_score - pyramid.offset) / pyramid.scale * count)
    best_rank = np.int64(2**62)
    best_k, best_j, best_i = np.int64(half_theta), np.int64(half_y), np.int64(half_x)
    found = False
    stack = empty_stack(top, bounds)
    for place in order:
        if bounds[place] < best:
            break
        k = place // (rows * columns)
        own_cells, own_shares = cells[k, : counts[k]], shares[k, : counts[k]]
        j, i = (place // columns) % rows * size, place % columns * size
        depth = push_block(stack, 0, top, j, i, bounds[place])
        while depth > 0:
            depth -= 1
            level, j, i = stack.blocks[depth, 0], stack.blocks[depth, 1], stack.blocks[depth, 2]
            bound = stack.bounds[depth]
            if bound < best:
                continue
            edge = (1 << level) - 1
            rank = (
                (k - half_theta) ** 2
                + nearest_square(j - half_y, min(j + edge, 2 * half_y) - half_y)
                + nearest_square(i - half_x, min(i + edge, 2 * half_x) - half_x)
            )
            if bound == best and found and rank > best_rank:
                continue
            if level == 0:
                if bound > best or not found or rank < best_rank or (k, j, i) < (best_k, best_j, best_i):
                    best, best_rank, found = bound, rank, True
                    best_k, best_j, best_i = k, j, i
                continue
            half = 1 << (level - 1)
            parts = 0
            for row in (j, j + half):
                for column in (i, i + half):
                    if row > 2 * half_y or column > 2 * half_x:
                        continue
                    total = block_sum(
                        own_cells, own_shares, pyramid, level - 1, row - half_y, column - half_x
                    )
                    parts = insert_part(stack, parts, total, row, column)
            evaluated += parts
            depth = push_parts(stack, depth, parts, level - 1, best)
    result = result_of(count, pyramid, window, best, best_k, best_j, best_i, evaluated)
    if not found:
        return SearchResult(result.pose, -np.inf, half_theta, half_y, half_x, evaluated)
    return result
