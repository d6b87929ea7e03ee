"""Exhaustive search for the pose at which a scan lies best on a likelihood map, and branch and bound for it.

Every candidate of a window is scored: a number of headings, and for each of them shifts by whole cells.
Turning costs, shifting does not: the cell of each point is found once a heading, then blocks are added up.
Branch and bound asks far fewer candidates of a large window and is certain to find the same one.
The score is a mean over the points; on a layer of logarithms that is the logarithm of a product.
Sums are float32 in the order of the points. Rounding keeps order, so a bound is never below what it bounds.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from service.kernels.tiles import NO_TILE, TileIndex, find_tile


class LikelihoodLayer(NamedTuple):
    """A likelihood map of one resolution. The value of a cell c is offset + scale * c.

    tiles    TileIndex                          tiles of T x T cells, T any
    cells    (capacity, T, T)  uint8 or float32
    empty    float    what a cell counts where no tile lies, in the unit of cells
    offset   float
    scale    float    above 0
    cell_m   float
    """

    tiles: TileIndex
    cells: npt.NDArray[np.uint8] | npt.NDArray[np.float32]
    empty: float
    offset: float
    scale: float
    cell_m: float


class SearchWindow(NamedTuple):
    """Candidates (k, j, i): the centre, turned by (k - half_theta) steps about the base, then moved by
    (i - half_x, j - half_y) cells along the axes of the map.

    pose             (3,) float64   x m, y m, theta rad of the base in the frame of the map: the centre
    half_x, half_y   int            cells
    half_theta       int            steps
    theta_step_rad   float
    """

    pose: npt.NDArray[np.float64]
    half_x: int
    half_y: int
    half_theta: int
    theta_step_rad: float


class MaxPyramid(NamedTuple):
    """Cell (r, c) of level l is the maximum over the 2^l x 2^l cells of the layer from there towards +x, +y.

    levels           (L, H, W)  uint8 or float32, as the cells of the layer
    first_row, first_column   int   which cell of the layer is levels[0, 0, 0]
    empty, offset, scale, cell_m    as in the layer
    """

    levels: npt.NDArray[np.uint8] | npt.NDArray[np.float32]
    first_row: int
    first_column: int
    empty: float
    offset: float
    scale: float
    cell_m: float


class SearchResult(NamedTuple):
    """The best candidate. Of equal scores the one nearest the centre wins, by the sum of the squares of its
    steps along x, y and theta; then the least k, j, i.

    pose         (3,) float64   x m, y m, theta rad in the frame of the map
    score        float          weighted mean of the values at the points; -inf where none reached the least
    k, j, i      int            which candidate
    evaluated    int            candidates and blocks of candidates whose points were added up
    """

    pose: npt.NDArray[np.float64]
    score: float
    k: int
    j: int
    i: int
    evaluated: int


@njit(cache=True, nogil=True)
def turned_cells(xy_base, weights, window, k, cell_m, cells, shares):
    """Cells of the points at heading k of a window, at its centre; neighbours in one cell are put together.

    xy_base   (N, 2) float64   m, base frame
    weights   (N,)   float32
    cells     (N, 2) int64     out: row, column
    shares    (N,)   float32   out: sum of the weights in each
    Returns how many there are.
    """
    theta = window.pose[2] + (k - window.half_theta) * window.theta_step_rad
    c = math.cos(theta) / cell_m
    s = math.sin(theta) / cell_m
    x = window.pose[0] / cell_m
    y = window.pose[1] / cell_m
    count = 0
    for n in range(xy_base.shape[0]):
        row = math.floor(y + s * xy_base[n, 0] + c * xy_base[n, 1])
        column = math.floor(x + c * xy_base[n, 0] - s * xy_base[n, 1])
        if count > 0 and cells[count - 1, 0] == row and cells[count - 1, 1] == column:
            shares[count - 1] += weights[n]
            continue
        cells[count, 0] = row
        cells[count, 1] = column
        shares[count] = weights[n]
        count += 1
    return count


@njit(cache=True, nogil=True)
def add_block(layer, values, row, column, weight, shape, sums, begin):
    """Add weight times the cells [row, row + J) x [column, column + I) of a layer to sums.

    values        layer.cells, flat
    row, column   int
    weight        float32
    shape         (J, I) int
    sums          flat float32, in and out; J rows of I from `begin` on
    Indices are unsigned and arrays flat: with no sign to ask for, the inner loops add many cells at once.
    """
    rows, columns = shape
    tile_cells = layer.cells.shape[1]
    empty = weight * np.float32(layer.empty)
    j = 0
    while j < rows:
        tile_row = (row + j) // tile_cells
        r = row + j - tile_row * tile_cells
        height = min(tile_cells - r, rows - j)
        i = 0
        while i < columns:
            tile_column = (column + i) // tile_cells
            c = column + i - tile_column * tile_cells
            width = min(tile_cells - c, columns - i)
            slot = find_tile(layer.tiles, tile_row, tile_column)
            for a in range(height):
                to = np.uint64(begin + (j + a) * columns + i)
                if slot == NO_TILE:
                    for b in range(np.uint64(width)):
                        sums[to + b] += empty
                else:
                    of = np.uint64((slot * tile_cells + r + a) * tile_cells + c)
                    for b in range(np.uint64(width)):
                        sums[to + b] += weight * np.float32(values[of + b])
            i += width
        j += height


@njit(cache=True, nogil=True)
def score_window(xy_base, weights, layer, window):
    """Weighted sum of cells at the points, for every candidate of a window.

    xy_base   (N, 2) float64   m, base frame
    weights   (N,)   float32
    Returns sums (K, J, I) float32, in the unit of cells: K headings, J shifts along y, I shifts along x.
    Source: Olson 2009, Real-Time Correlative Scan Matching, section III.
    """
    sums = np.zeros((2 * window.half_theta + 1, 2 * window.half_y + 1, 2 * window.half_x + 1), np.float32)
    cells = np.empty((xy_base.shape[0], 2), np.int64)
    shares = np.empty(xy_base.shape[0], np.float32)
    shape = (sums.shape[1], sums.shape[2])
    values = layer.cells.reshape(-1)
    flat = sums.reshape(-1)
    tile_cells = layer.cells.shape[1]
    row_room = tile_cells - shape[0]  # a block that begins so far into a tile at most lies in it as a whole
    column_room = tile_cells - shape[1]
    tile_row = tile_column = np.int64(0)
    slot = np.int64(find_tile(layer.tiles, tile_row, tile_column))
    for k in range(sums.shape[0]):
        count = turned_cells(xy_base, weights, window, k, layer.cell_m, cells, shares)
        begin = k * shape[0] * shape[1]
        for n in range(count):
            row = cells[n, 0] - window.half_y
            column = cells[n, 1] - window.half_x
            r = row - tile_row * tile_cells
            c = column - tile_column * tile_cells
            if not (0 <= r < tile_cells and 0 <= c < tile_cells):
                tile_row = row // tile_cells
                tile_column = column // tile_cells
                slot = np.int64(find_tile(layer.tiles, tile_row, tile_column))
                r = row - tile_row * tile_cells
                c = column - tile_column * tile_cells
            if slot == NO_TILE or r > row_room or c > column_room:
                add_block(layer, values, row, column, shares[n], shape, flat, begin)
                continue
            weight = shares[n]
            to = np.uint64(begin)
            of = np.uint64((slot * tile_cells + r) * tile_cells + c)
            for _ in range(shape[0]):
                for b in range(np.uint64(shape[1])):
                    flat[to + b] += weight * np.float32(values[of + b])
                to += np.uint64(shape[1])
                of += np.uint64(tile_cells)
    return sums


@njit(cache=True, nogil=True)
def result_of(weights, layer, window, total, k, j, i, evaluated):
    """SearchResult of a candidate with the sum `total`; layer: LikelihoodLayer or MaxPyramid."""
    pose = np.empty(3)
    pose[0] = window.pose[0] + (i - window.half_x) * layer.cell_m
    pose[1] = window.pose[1] + (j - window.half_y) * layer.cell_m
    pose[2] = window.pose[2] + (k - window.half_theta) * window.theta_step_rad
    weight = 0.0
    for n in range(weights.shape[0]):
        weight += weights[n]
    score = layer.offset + layer.scale * total / max(weight, 1e-12)
    return SearchResult(pose, score, k, j, i, evaluated)


@njit(cache=True, nogil=True)
def search_exhaustive(xy_base, weights, layer, window):
    """The best candidate of a window, by asking every one, and the sums of all.

    xy_base   (N, 2) float64   m, base frame
    weights   (N,)   float32
    Returns (SearchResult, sums (K, J, I) float32 as from score_window).
    """
    sums = score_window(xy_base, weights, layer, window)
    best_k, best_j, best_i = 0, 0, 0
    best = np.float32(-np.inf)
    best_rank = np.int64(0)
    for k in range(sums.shape[0]):
        for j in range(sums.shape[1]):
            for i in range(sums.shape[2]):
                total = sums[k, j, i]
                if total < best:
                    continue
                rank = (k - window.half_theta) ** 2 + (j - window.half_y) ** 2 + (i - window.half_x) ** 2
                if total > best or rank < best_rank:  # in order of (k, j, i): the first of equals stays
                    best, best_rank = total, rank
                    best_k, best_j, best_i = k, j, i
    return result_of(weights, layer, window, best, best_k, best_j, best_i, sums.size), sums


@njit(cache=True, nogil=True)
def cells_asked(xy_base, window, cell_m):
    """Cells of a layer that the points can come to lie in: rows [first, last], then columns, as 4 int."""
    nowhere = np.int64(2**62)
    first_row, last_row, first_column, last_column = nowhere, -nowhere, nowhere, -nowhere
    for k in range(2 * window.half_theta + 1):
        theta = window.pose[2] + (k - window.half_theta) * window.theta_step_rad
        c = math.cos(theta) / cell_m
        s = math.sin(theta) / cell_m
        x = window.pose[0] / cell_m
        y = window.pose[1] / cell_m
        for n in range(xy_base.shape[0]):
            row = np.int64(math.floor(y + s * xy_base[n, 0] + c * xy_base[n, 1]))
            column = np.int64(math.floor(x + c * xy_base[n, 0] - s * xy_base[n, 1]))
            first_row = min(first_row, row)
            last_row = max(last_row, row)
            first_column = min(first_column, column)
            last_column = max(last_column, column)
    return (
        first_row - window.half_y,
        last_row + window.half_y,
        first_column - window.half_x,
        last_column + window.half_x,
    )


@njit(cache=True, nogil=True)
def build_pyramid(layer, first_row, first_column, levels):
    """Fill a max pyramid from the part of a layer that begins at a cell.

    first_row, first_column   int   the cell of the layer that becomes levels[0, 0, 0]; see padding_cells
    levels                    (L, H, W)  out, of the type of layer.cells
    Returns a MaxPyramid over `levels`. What it does not cover counts as empty.
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


@njit(cache=True, nogil=True)
def pool_levels(levels, empty):
    """Fill levels 1 and up from level 0; beyond the upper borders all is `empty`."""
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


@njit(cache=True, nogil=True)
def block_sum(cells, shares, pyramid, level, shift_row, shift_column):
    """Weighted sum of a level at shifted points: no less than that of any candidate in the block.

    cells     (C, 2) int64     row and column in the layer, from turned_cells
    shares    (C,)   float32   none below 0
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
            total += shares[n] * np.float32(field[row, column])
        else:
            total += shares[n] * empty
    return total


@njit(cache=True, nogil=True)
def nearest_square(low, high):
    """Square of the number nearest to 0 in [low, high]."""
    if low > 0:
        return low * low
    return high * high if high < 0 else 0


@njit(cache=True, nogil=True)
def search_branch_and_bound(xy_base, weights, pyramid, window, least_score):
    """The candidate that search_exhaustive finds on the layer of the pyramid, without asking most of them.

    xy_base       (N, 2) float64   m, base frame
    weights       (N,)   float32   none below 0
    pyramid       MaxPyramid
    least_score   float            nothing is returned below it; -inf asks for the best however poor
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
    weight = 0.0
    for n in range(count):
        weight += weights[n]

    cells = np.empty((heading_count, count, 2), np.int64)
    shares = np.empty((heading_count, count), np.float32)
    counts = np.empty(heading_count, np.int64)
    bounds = np.empty(heading_count * rows * columns, np.float32)
    for k in range(heading_count):
        counts[k] = turned_cells(xy_base, weights, window, k, pyramid.cell_m, cells[k], shares[k])
        own_cells, own_shares = cells[k, : counts[k]], shares[k, : counts[k]]
        for a in range(rows):
            for b in range(columns):
                bounds[(k * rows + a) * columns + b] = block_sum(
                    own_cells, own_shares, pyramid, top, a * size - half_y, b * size - half_x
                )
    order = np.argsort(-bounds, kind="mergesort")
    evaluated = bounds.size

    best = np.float32((least_score - pyramid.offset) / pyramid.scale * weight)
    best_rank = np.int64(2**62)
    best_k, best_j, best_i = np.int64(half_theta), np.int64(half_y), np.int64(half_x)
    found = False
    stack = np.empty((4 * top + 4, 3), np.int64)  # level, j, i of blocks to look into, best on top
    stack_bounds = np.empty(4 * top + 4, np.float32)
    child = np.empty((4, 2), np.int64)
    child_bounds = np.empty(4, np.float32)
    for place in order:
        if bounds[place] < best:
            break
        k = place // (rows * columns)
        own_cells, own_shares = cells[k, : counts[k]], shares[k, : counts[k]]
        depth = 1
        stack[0, 0] = top
        stack[0, 1] = (place // columns) % rows * size
        stack[0, 2] = place % columns * size
        stack_bounds[0] = bounds[place]
        turned_square = (k - half_theta) ** 2
        while depth > 0:
            depth -= 1
            level, j, i = stack[depth, 0], stack[depth, 1], stack[depth, 2]
            bound = stack_bounds[depth]
            if bound < best:
                continue
            edge = (1 << level) - 1
            rank = (
                turned_square
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
            children = 0
            for a in range(2):
                for b in range(2):
                    if j + a * half > 2 * half_y or i + b * half > 2 * half_x:
                        continue
                    total = block_sum(
                        own_cells,
                        own_shares,
                        pyramid,
                        level - 1,
                        j + a * half - half_y,
                        i + b * half - half_x,
                    )
                    evaluated += 1
                    at = children
                    while at > 0 and child_bounds[at - 1] > total:  # rising: the best is pushed last
                        child_bounds[at] = child_bounds[at - 1]
                        child[at] = child[at - 1]
                        at -= 1
                    child_bounds[at] = total
                    child[at, 0] = j + a * half
                    child[at, 1] = i + b * half
                    children += 1
            for at in range(children):
                if child_bounds[at] >= best:
                    stack[depth, 0] = level - 1
                    stack[depth, 1] = child[at, 0]
                    stack[depth, 2] = child[at, 1]
                    stack_bounds[depth] = child_bounds[at]
                    depth += 1
    result = result_of(weights, pyramid, window, best, best_k, best_j, best_i, evaluated)
    if not found:
        return SearchResult(result.pose, -np.inf, half_theta, half_y, half_x, evaluated)
    return result


@njit(cache=True, nogil=True)
def surface_moments(sums, best, temperature):
    """Mean and covariance of the candidates, each counted exp((sum - best) / temperature).

    sums          (K, J, I) float32
    best          float    the largest sum
    temperature   float    in the unit of the sums
    Returns (mean (3,), covariance (3, 3)) float64, of i, j, k in cells and steps from candidate (0, 0, 0).
    Source: Olson 2009, eqs. (7) to (9).
    """
    mean = np.zeros(3)
    square = np.zeros((3, 3))
    whole = 0.0
    for k in range(sums.shape[0]):
        for j in range(sums.shape[1]):
            for i in range(sums.shape[2]):
                p = math.exp((sums[k, j, i] - best) / temperature)
                whole += p
                mean[0] += p * i
                mean[1] += p * j
                mean[2] += p * k
                square[0, 0] += p * i * i
                square[0, 1] += p * i * j
                square[0, 2] += p * i * k
                square[1, 1] += p * j * j
                square[1, 2] += p * j * k
                square[2, 2] += p * k * k
    covariance = np.empty((3, 3))
    for a in range(3):
        mean[a] /= whole
    for a in range(3):
        for b in range(a, 3):
            covariance[a, b] = square[a, b] / whole - mean[a] * mean[b]
            covariance[b, a] = covariance[a, b]
    return mean, covariance
