"""Exhaustive search for the pose at which a scan fits a likelihood map best.

Every candidate of a window is scored: headings, and for each heading shifts by cells. The cells of the points
are computed once per heading; shifts then add up blocks of cells. Branch and bound (branch_and_bound.py)
finds the same pose of a large window with far fewer evaluations.
The score is a mean over the points; on a layer of logarithms it is the logarithm of a product.
Sums are float32 in the order of the points.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.arrays import Float32_3D, Float64_1D, Float64_2D, LikelihoodCells
from service.kernels.compiled import inner_kernel, seldom_kernel
from service.kernels.tiles import NO_TILE, TileIndex, find_tile


class LikelihoodLayer(NamedTuple):
    """A likelihood map of one resolution. The value of a cell c is offset + scale * c.

    tiles    TileIndex                          tiles of T x T cells, T any
    cells    (capacity, T, T)  uint8 or float32
    empty    float    value without a tile, in the unit of cells
    offset   float
    scale    float    above 0
    cell_m   float
    """

    tiles: TileIndex
    cells: LikelihoodCells
    empty: float
    offset: float
    scale: float
    cell_m: float


ByteLayer = Annotated[LikelihoodLayer, 1]  # the second kind of LikelihoodCells


class SearchWindow(NamedTuple):
    """Candidates (k, j, i): the centre, rotated by (k - half_theta) steps about the base, then shifted by
    (i - half_x, j - half_y) cells along the axes of the map.

    pose             (3,) float64   x m, y m, theta rad of the base in the frame of the map: the centre
    half_x, half_y   int            cells
    half_theta       int            steps
    theta_step_rad   float
    """

    pose: Float64_1D
    half_x: int
    half_y: int
    half_theta: int
    theta_step_rad: float


class SearchResult(NamedTuple):
    """The best candidate. Of equal scores the one nearest the centre wins, by the sum of the squares of its
    steps along x, y and theta; then the least k, j, i.

    pose         (3,) float64   x m, y m, theta rad in the frame of the map
    score        float          mean of the values at the points; -inf where none reached the least
    k, j, i      int            index of the candidate
    evaluated    int            candidates and blocks of candidates evaluated
    """

    pose: npt.NDArray[np.float64]
    score: float
    k: int
    j: int
    i: int
    evaluated: int


@inner_kernel
def turned_cells(xy_base, window, k, cell_m, cells, counts):
    """Cells of the points at heading k of a window, at its centre; consecutive equal cells are merged.

    xy_base   (N, 2) float64   m, base frame
    cells     (N, 2) int64     out: row, column
    counts    (N,)   float32   out: points in each
    Returns the number of cells.
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
            counts[count - 1] += np.float32(1.0)
            continue
        cells[count, 0] = row
        cells[count, 1] = column
        counts[count] = np.float32(1.0)
        count += 1
    return count


@inner_kernel
def add_block(layer, values, row, column, weight, shape, sums, begin):
    """Add weight times the cells [row, row + J) x [column, column + I) of a layer to sums.

    values        layer.cells, flat
    row, column   int
    weight        float32
    shape         (J, I) int
    sums          flat float32, in and out; J rows of I from `begin` on
    Flat arrays and unsigned indices let the compiler vectorise the inner loops.
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


@inner_kernel
def score_window(xy_base, layer, window):
    """Sum of cells at the points, for every candidate of a window.

    xy_base   (N, 2) float64   m, base frame
    Returns sums (K, J, I) float32, in the unit of cells: K headings, J shifts along y, I shifts along x.
    Source: Olson 2009, Real-Time Correlative Scan Matching, section III.
    """
    sums = np.zeros((2 * window.half_theta + 1, 2 * window.half_y + 1, 2 * window.half_x + 1), np.float32)
    cells = np.empty((xy_base.shape[0], 2), np.int64)
    counts = np.empty(xy_base.shape[0], np.float32)
    shape = (sums.shape[1], sums.shape[2])
    values = layer.cells.reshape(-1)
    flat = sums.reshape(-1)
    tile_cells = layer.cells.shape[1]
    row_room = tile_cells - shape[0]  # a block that begins at most here lies within one tile
    column_room = tile_cells - shape[1]
    tile_row = tile_column = np.int64(0)
    slot = np.int64(find_tile(layer.tiles, tile_row, tile_column))
    for k in range(sums.shape[0]):
        count = turned_cells(xy_base, window, k, layer.cell_m, cells, counts)
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
                add_block(layer, values, row, column, counts[n], shape, flat, begin)
                continue
            weight = counts[n]
            to = np.uint64(begin)
            of = np.uint64((slot * tile_cells + r) * tile_cells + c)
            for _ in range(shape[0]):
                for b in range(np.uint64(shape[1])):
                    flat[to + b] += weight * np.float32(values[of + b])
                to += np.uint64(shape[1])
                of += np.uint64(tile_cells)
    return sums


@inner_kernel
def result_of(count, layer, window, total, k, j, i, evaluated):
    """SearchResult of a candidate with the sum `total` over so many points; layer: or MaxPyramid."""
    pose = np.empty(3)
    pose[0] = window.pose[0] + (i - window.half_x) * layer.cell_m
    pose[1] = window.pose[1] + (j - window.half_y) * layer.cell_m
    pose[2] = window.pose[2] + (k - window.half_theta) * window.theta_step_rad
    score = layer.offset + layer.scale * total / max(count, 1)
    return SearchResult(pose, score, k, j, i, evaluated)


@seldom_kernel(Float64_2D, LikelihoodLayer, SearchWindow)
def search_exhaustive(xy_base, layer, window):
    """The best candidate of a window, by evaluating all of them, and their sums.

    xy_base   (N, 2) float64   m, base frame
    Returns (SearchResult, sums (K, J, I) float32 as from score_window).
    """
    sums = score_window(xy_base, layer, window)
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
                if total > best or rank < best_rank:  # ties: the first in order of (k, j, i)
                    best, best_rank = total, rank
                    best_k, best_j, best_i = k, j, i
    return result_of(xy_base.shape[0], layer, window, best, best_k, best_j, best_i, sums.size), sums


@seldom_kernel(Float64_2D, SearchWindow, float)
def cell_bounds(xy_base, window, cell_m):
    """Range of cells that the points can fall into: first and last row, first and last column."""
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


@seldom_kernel(Float32_3D, float, float)
def surface_moments(sums, best, temperature):
    """Mean and covariance of the candidates, weighted by exp((sum - best) / temperature).

    sums          (K, J, I) float32
    best          float    the largest sum
    temperature   float    in the unit of the sums
    Returns (mean (3,), covariance (3, 3)) float64, of i, j, k in cells and steps from candidate (0, 0, 0).
    Source: Olson 2009, eqs. (7) to (9).
    """
    mean = np.zeros(3)
    square = np.zeros((3, 3))
    total_weight = 0.0
    for k in range(sums.shape[0]):
        for j in range(sums.shape[1]):
            for i in range(sums.shape[2]):
                p = math.exp((sums[k, j, i] - best) / temperature)
                total_weight += p
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
        mean[a] /= total_weight
    for a in range(3):
        for b in range(a, 3):
            covariance[a, b] = square[a, b] / total_weight - mean[a] * mean[b]
            covariance[b, a] = covariance[a, b]
    return mean, covariance
