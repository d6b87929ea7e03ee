"""The three-level likelihood map: lines through the points of a scan with two rings around, never lowered."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D, UInt8_1D, UInt8_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.likelihood_search import ByteLayer
from service.kernels.tiles import NO_TILE, find_tile

RINGS = 2  # around the cell that is hit


@inner_kernel
def raise_cell(layer, changed, row, column, levels, ring_cells):
    """Raise a cell to the level of a hit, and two rings around it to theirs; greater values stay.

    layer     LikelihoodLayer  in and out; every cell within the rings has a tile
    changed   (capacity,) uint8   set to 1 for the tiles touched
    levels    (3,) uint8   value of the hit, of the first ring, of the second
    ring_cells   int   width of a ring
    Source: Tang et al. 2014, section 2.3 and fig. 4a, 4b.
    """
    cells = layer.cells
    tile_cells = cells.shape[1]
    tile_row = row // tile_cells
    tile_column = column // tile_cells
    r = row - tile_row * tile_cells
    c = column - tile_column * tile_cells
    reach = RINGS * ring_cells
    if reach <= r < tile_cells - reach and reach <= c < tile_cells - reach:
        slot = find_tile(layer.tiles, tile_row, tile_column)
        if cells[slot, r, c] == levels[0]:
            return  # hit before: its rings exist
        changed[slot] = 1
        flat = cells.reshape(-1)  # flat, with unsigned indices, so that the inner loop is vectorised
        for ring in range(RINGS, -1, -1):
            around = ring * ring_cells
            level = levels[ring]
            for a in range(-around, around + 1):
                begin = np.uint64((slot * tile_cells + r + a) * tile_cells + c - around)
                for b in range(np.uint64(2 * around + 1)):
                    flat[begin + b] = max(flat[begin + b], level)
        return
    for a in range(-reach, reach + 1):
        for b in range(-reach, reach + 1):
            tile_row = (row + a) // tile_cells
            tile_column = (column + b) // tile_cells
            slot = find_tile(layer.tiles, tile_row, tile_column)
            level = levels[(max(abs(a), abs(b)) + ring_cells - 1) // ring_cells]
            r = row + a - tile_row * tile_cells
            c = column + b - tile_column * tile_cells
            if slot != NO_TILE and cells[slot, r, c] < level:
                changed[slot] = 1
                cells[slot, r, c] = level


@kernel(Float64_2D, Int32_1D, ByteLayer, UInt8_1D, UInt8_1D, int, Float64_1D)
def rasterise_scan(xy_map, beam, layer, changed, levels, ring_cells, join_m):
    """Rasterise a scan: a cell for each point, and a line between neighbouring beams that end close together.

    xy_map    (N, 2) float64   m, frame of the map, in beam order
    beam      (N,)   int32     index of the beam; no line crosses a beam without return
    layer     LikelihoodLayer  in and out, with a tile wherever a point or its rings lie
    changed   (capacity,) uint8   in and out
    levels    (3,)   uint8     as in raise_cell, and
    ring_cells   int
    join_m    (N,) float64     "a certain distance": longest line from the point before
    Source: Tang et al. 2014, section 2.3 and fig. 4c.
    """
    cell_m = layer.cell_m
    for n in range(xy_map.shape[0]):
        u = xy_map[n, 0] / cell_m
        v = xy_map[n, 1] / cell_m
        raise_cell(layer, changed, math.floor(v), math.floor(u), levels, ring_cells)
        if n == 0 or beam[n] != beam[n - 1] + 1:
            continue
        du = u - xy_map[n - 1, 0] / cell_m
        dv = v - xy_map[n - 1, 1] / cell_m
        if du * du + dv * dv > (join_m[n] / cell_m) ** 2:
            continue
        count = math.ceil(max(abs(du), abs(dv)))  # at most a cell between consecutive points of the line
        for k in range(1, count):
            share = k / count
            raise_cell(
                layer, changed, math.floor(v - share * dv), math.floor(u - share * du), levels, ring_cells
            )


@inner_kernel
def mean_value(xy_base, pose, layer):
    """Mean value of the cells at the points, in the unit of the cells.

    xy_base   (N, 2) float64   m, base frame; N > 0
    pose      (3,)   float64   base in the frame of the map
    """
    cells = layer.cells
    tile_cells = cells.shape[1]
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    total = 0.0
    for n in range(xy_base.shape[0]):
        row = math.floor((pose[1] + s * xy_base[n, 0] + c * xy_base[n, 1]) / layer.cell_m)
        column = math.floor((pose[0] + c * xy_base[n, 0] - s * xy_base[n, 1]) / layer.cell_m)
        slot = find_tile(layer.tiles, row // tile_cells, column // tile_cells)
        total += layer.empty if slot == NO_TILE else cells[slot, row % tile_cells, column % tile_cells]
    return total / xy_base.shape[0]


@kernel(Float64_2D, ByteLayer, Float64_1D, Float64_2D, float, float)
def monte_carlo_search(xy_base, layer, start, deviates, sigma_m, sigma_rad):
    """Random search around the best pose so far, with smaller steps after enough failed trials.

    xy_base     (N, 2) float64   m, base frame; N > 0
    layer       LikelihoodLayer
    start       (3,)   float64   base in the frame of the map
    deviates    (3 T, 3) float64 normal deviates, a row a trial; the search ends after T failed trials
    sigma_m, sigma_rad   float   of the first trials
    Returns (pose (3,), mean value there, trials).
    Source: Steux and El Hamzaoui 2010, tinySLAM, ts_monte_carlo_search; reference 28 of Tang et al. 2014.
    """
    stop = deviates.shape[0] // 3
    best = start.copy()
    best_value = mean_value(xy_base, start, layer)
    centre = start.copy()
    centre_value = best_value
    trial = start.copy()
    in_vain = 0
    for t in range(deviates.shape[0]):
        trial[0] = centre[0] + sigma_m * deviates[t, 0]
        trial[1] = centre[1] + sigma_m * deviates[t, 1]
        trial[2] = centre[2] + sigma_rad * deviates[t, 2]
        value = mean_value(xy_base, trial, layer)
        if value > best_value:
            best_value = value
            best = trial.copy()
        else:
            in_vain += 1
        if in_vain > stop // 3 and best_value > centre_value:
            centre = best
            centre_value = best_value
            in_vain = 0
            sigma_m *= 0.5
            sigma_rad *= 0.5
        if in_vain >= stop:
            return best, best_value, t + 1
    return best, best_value, deviates.shape[0]


@kernel(Float64_2D, Int32_1D, Float64_1D, float, Float64_2D)
def smooth_lines(xy_map, beam, join_m, half_m, smooth):
    """Replace each point by the mean of as many neighbours on each side as are within reach on its line.

    xy_map   (N, 2) float64   m, in beam order
    beam     (N,)   int32
    join_m   (N,)   float64   as in rasterise_scan: a longer step ends a line
    half_m   float            reach
    smooth   (N, 2) float64   out
    """
    count = xy_map.shape[0]
    joined = np.zeros(count + 1, np.bool_)  # with the point before
    for n in range(1, count):
        joined[n] = beam[n] == beam[n - 1] + 1 and square_between(xy_map, n, n - 1) <= join_m[n] ** 2
    for n in range(count):
        x = xy_map[n, 0]
        y = xy_map[n, 1]
        taken = 1
        left = right = n
        while left > 0 and right < count - 1:
            if not joined[left] or not joined[right + 1]:
                break
            farther = max(square_between(xy_map, n, left - 1), square_between(xy_map, n, right + 1))
            if farther > half_m * half_m:
                break
            left -= 1
            right += 1
            x += xy_map[left, 0] + xy_map[right, 0]
            y += xy_map[left, 1] + xy_map[right, 1]
            taken += 2
        smooth[n, 0] = x / taken
        smooth[n, 1] = y / taken


@inner_kernel
def square_between(xy, a, b):
    return (xy[a, 0] - xy[b, 0]) ** 2 + (xy[a, 1] - xy[b, 1]) ** 2


@kernel(Float64_2D, float, float, int, int, UInt8_2D)
def mark_patches(xy_map, margin_m, patch_m, first_row, first_column, marks):
    """Mark the patches within a margin, at most half a patch, of some points.

    xy_map   (N, 2) float64   m, frame of the map
    first_row, first_column   int   patch of marks[0, 0]
    marks    (H, W) uint8     out: set to 1 for each patch inside the array
    """
    for n in range(xy_map.shape[0]):
        low_row = math.floor((xy_map[n, 1] - margin_m) / patch_m) - first_row
        low_column = math.floor((xy_map[n, 0] - margin_m) / patch_m) - first_column
        high_row = math.floor((xy_map[n, 1] + margin_m) / patch_m) - first_row
        high_column = math.floor((xy_map[n, 0] + margin_m) / patch_m) - first_column
        for row in range(max(low_row, 0), min(high_row, marks.shape[0] - 1) + 1):
            for column in range(max(low_column, 0), min(high_column, marks.shape[1] - 1) + 1):
                marks[row, column] = 1
