"""The likelihood map of one scan: contours blurred along and across, in the cells of a tiled map."""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import (
    Float32_1D,
    Float32_3D,
    Float64_1D,
    Float64_2D,
    Int32_1D,
    Int32_2D,
    Int32_3D,
    Int64_1D,
    UInt8_1D,
    UInt16_3D,
)
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.contours import ALONE
from service.kernels.pose_information import wrap
from service.kernels.surfels import TILE_BITS, TILE_MASK
from service.kernels.tiles import NO_TILE, TileIndex, find_tile, take_slot

PASSED, BLURRED, HIT = range(
    3
)  # observation of a cell by a scan: a beam passed, a contour is near, a point is in it
NODES_APART_CELLS = 1.0  # of a contour, at least


class LikelihoodLevel(NamedTuple):
    """One resolution of the learned map.

    tiles        TileIndex                   tiles of 2**TILE_BITS cells a side
    likelihood   (capacity, T, T)  float32   M^p, 0 to 1
    highest      (capacity, T, T)  float32   M^p-hat, the highest so far
    seen         (capacity, T, T)  uint16    M^n, number of scans; saturates
    mark         (capacity, T, T)  int32     row of the cell in the scan's list + 1; 0 between two scans
    cell_m       float
    """

    tiles: TileIndex
    likelihood: Float32_3D
    highest: Float32_3D
    seen: UInt16_3D
    mark: Int32_3D
    cell_m: float


class ScanCells(NamedTuple):
    """The cells observed by one scan.

    place    (M, 3) int32     tile slot; row and column of the cell in the map
    kind     (M,)   uint8     PASSED, BLURRED or HIT
    value    (M,)   float32   likelihood in the scan's own map; 0 where a beam passed
    fall     (M,)   float32   p_d of eq. 17, filled in while learning
    rows     (1,)   int64     number of cells; above M the rows beyond are missing
    """

    place: Int32_2D
    kind: UInt8_1D
    value: Float32_1D
    fall: Float32_1D
    rows: Int64_1D


class BlurSettings(NamedTuple):
    """Documented where they are configured."""

    along_cells: float  # inf: the entire contour is as likely as its points (the traditional map)
    across_cells: float
    is_squared: bool
    least: float  # smaller likelihoods count as 0
    uses_lone_points: bool


@inner_kernel
def touch_cell(level, row, column, cells):
    """Row of a cell in the scan's list, appended with value 0 if absent; -1 where the list is full."""
    slot = find_tile(level.tiles, row >> TILE_BITS, column >> TILE_BITS)
    if slot == NO_TILE:
        slot, used_before = take_slot(level.tiles, row >> TILE_BITS, column >> TILE_BITS)
        if used_before:
            level.likelihood[slot] = np.float32(0.0)
            level.highest[slot] = np.float32(0.0)
            level.seen[slot] = np.uint16(0)
            level.mark[slot] = np.int32(0)
    r = row & TILE_MASK
    q = column & TILE_MASK
    k = np.int64(level.mark[slot, r, q]) - 1
    if k >= 0:
        return k
    k = cells.rows[0]
    cells.rows[0] += 1
    if k >= cells.value.shape[0]:
        return np.int64(-1)
    level.mark[slot, r, q] = k + 1
    cells.place[k, 0] = slot
    cells.place[k, 1] = row
    cells.place[k, 2] = column
    cells.kind[k] = PASSED
    cells.value[k] = np.float32(0.0)
    cells.fall[k] = np.float32(0.0)
    return k


@inner_kernel
def raise_cell(level, row, column, value, cells):
    """Raise the likelihood of a cell in the scan's own map to at least a value."""
    k = touch_cell(level, row, column, cells)
    if k >= 0:
        cells.kind[k] = max(cells.kind[k], np.uint8(BLURRED))
        cells.value[k] = max(cells.value[k], np.float32(value))


@kernel(LikelihoodLevel, ScanCells)
def clear_scan(level, cells):
    """Clear the marks of a scan in the map and empty its list."""
    for k in range(min(cells.rows[0], cells.value.shape[0])):
        level.mark[cells.place[k, 0], cells.place[k, 1] & TILE_MASK, cells.place[k, 2] & TILE_MASK] = 0
    cells.rows[0] = 0


@kernel(BlurSettings)
def blur_reach_cells(settings):
    """Distance across a contour beyond which its likelihood is negligible, cells."""
    log_least = -math.log(settings.least)
    return settings.across_cells * (math.sqrt(2.0 * log_least) if settings.is_squared else log_least)


@inner_kernel
def blurred(along, across, settings):
    """Likelihood by the distance along a contour from its nearest point and across it, cells.

    Source: Li et al. 2016, eq. 6; with is_squared a Gaussian, unlike the printed exponent.
    """
    u = along / settings.along_cells
    v = across / settings.across_cells
    if settings.is_squared:
        return math.exp(-0.5 * (u * u + v * v))
    return math.exp(-u - v)


@inner_kernel
def blur_segment(u0, v0, u1, v1, before, after, level, settings, cells):
    """Raise the cells beside one step of a contour.

    u0, v0, u1, v1   float   its ends, in cells of the level
    before, after    float   extension of the step beyond each end, cells
    Distances are those of the centre of a cell. Inside, d_x is the distance to the nearer end and d_y that to
    the step; beyond an end d_y is the distance to that end. Source: Li et al. 2016, eqs. 6 and 7.
    """
    reach = blur_reach_cells(settings)
    length = math.hypot(u1 - u0, v1 - v0)
    eu = 1.0
    ev = 0.0
    if length > 0.0:
        eu = (u1 - u0) / length
        ev = (v1 - v0) / length
    # Hoisted: a reference to an array of a tuple inside the loop costs more than the rest.
    slots = level.tiles.slots
    first_row = level.tiles.origin[0]
    first_column = level.tiles.origin[1]
    mark = level.mark
    kinds = cells.kind
    values = cells.value
    high_v = max(v0 - before * ev, v1 + after * ev) + reach * abs(eu)
    low_v = min(v0 - before * ev, v1 + after * ev) - reach * abs(eu)
    for row in range(math.ceil(low_v - 0.5), math.floor(high_v - 0.5) + 1):
        dv = row + 0.5 - v0
        # columns between both sides, and between both ends, of the rectangle
        low, high = interval(-ev, dv * eu, -reach, reach)
        low_t, high_t = interval(eu, dv * ev, -before, length + after)
        low = max(low, low_t)
        high = min(high, high_t)
        if not low <= high:
            continue
        for column in range(math.ceil(low + u0 - 0.5), math.floor(high + u0 - 0.5) + 1):
            du = column + 0.5 - u0
            t = du * eu + dv * ev
            across = abs(dv * eu - du * ev)
            along = min(t, length - t)
            if along < 0.0:
                along = -along
                across = math.sqrt(across * across + along * along)
            value = np.float32(blurred(along, across, settings))
            if value < settings.least:
                continue
            k = -1
            tile_row = (row >> TILE_BITS) - first_row
            tile_column = (column >> TILE_BITS) - first_column
            if 0 <= tile_row < slots.shape[0] and 0 <= tile_column < slots.shape[1]:
                slot = slots[tile_row, tile_column]
                if slot != NO_TILE:
                    k = mark[slot, row & TILE_MASK, column & TILE_MASK] - 1
            if k < 0:
                k = touch_cell(level, row, column, cells)
                if k < 0:
                    continue
                kinds[k] = BLURRED
            if value > values[k]:
                values[k] = value


@inner_kernel
def interval(slope, offset, low, high):
    """Solution of low <= slope x + offset <= high: (least x, greatest x), reversed where there is none."""
    if abs(slope) < 1e-9:
        return (-1e9, 1e9) if low <= offset <= high else (1.0, -1.0)
    a = (low - offset) / slope
    b = (high - offset) / slope
    return min(a, b), max(a, b)


@inner_kernel
def blur_point(u, v, level, settings, cells):
    """Raise the cells around an isolated point, by the narrower of the two blurs."""
    cells_wide = min(settings.along_cells, settings.across_cells)
    narrow = BlurSettings(cells_wide, cells_wide, settings.is_squared, settings.least, True)
    reach = blur_reach_cells(narrow)
    for row in range(math.ceil(v - reach - 0.5), math.floor(v + reach - 0.5) + 1):
        for column in range(math.ceil(u - reach - 0.5), math.floor(u + reach - 0.5) + 1):
            value = blurred(0.0, math.hypot(column + 0.5 - u, row + 0.5 - v), narrow)
            if value >= settings.least:
                raise_cell(level, row, column, value, cells)


@inner_kernel
def blur_contour(nodes, reach, level, settings, cells):
    """Blur one contour.

    nodes   (K, 2) float64   its points, K >= 2, cells
    reach   float            from blur_reach_cells
    At a bend the cells on its outer side are shared equally by both steps.
    """
    last = nodes.shape[0] - 2
    before = reach
    for k in range(last + 1):
        after = reach
        if k < last:
            ahead = math.atan2(nodes[k + 1, 1] - nodes[k, 1], nodes[k + 1, 0] - nodes[k, 0])
            onward = math.atan2(nodes[k + 2, 1] - nodes[k + 1, 1], nodes[k + 2, 0] - nodes[k + 1, 0])
            bend = abs(wrap(onward - ahead))
            after = reach * math.sin(0.5 * bend)
        blur_segment(
            nodes[k, 0], nodes[k, 1], nodes[k + 1, 0], nodes[k + 1, 1], before, after, level, settings, cells
        )
        before = after


@inner_kernel
def mark_hits(nodes, level, settings, cells):
    """Mark the cells of points as HIT; on a traditional map every cell that the contour crosses."""
    for k in range(nodes.shape[0]):
        steps = 1
        du = dv = 0.0
        if k + 1 < nodes.shape[0] and math.isinf(settings.along_cells):
            du = nodes[k + 1, 0] - nodes[k, 0]
            dv = nodes[k + 1, 1] - nodes[k, 1]
            steps = 1 + int(4.0 * math.hypot(du, dv))
        for step in range(steps):
            share = step / steps
            row = math.floor(nodes[k, 1] + share * dv)
            i = touch_cell(level, row, math.floor(nodes[k, 0] + share * du), cells)
            if i >= 0:
                cells.kind[i] = HIT


@kernel(Float64_2D, Int32_1D, Float64_1D, LikelihoodLevel, BlurSettings, ScanCells)
def blur_scan(xy_base, contour, pose, level, settings, cells):
    """The likelihood map of one scan, as a list of cells.

    xy_base    (N, 2) float64    end points, m, base frame
    contour    (N,)   int32      from extract_contours
    pose       (3,)   float64    base in the frame of the map
    level      LikelihoodLevel   in and out: marks and new tiles; its index covers the scan
    settings   BlurSettings
    cells      ScanCells         in: empty; out
    Likelihoods below settings.least are left out, except of cells that contain a point. Contours are blurred
    between points at least a cell apart, including their ends.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    count = xy_base.shape[0]
    uv = np.empty((count, 2))
    for i in range(count):
        uv[i, 0] = (pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) / level.cell_m
        uv[i, 1] = (pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) / level.cell_m
    reach = blur_reach_cells(settings)
    nodes = np.empty((count, 2))
    first = 0
    while first < count:
        last = first
        if contour[first] != ALONE:
            while last + 1 < count and contour[last + 1] == contour[first]:
                last += 1
        if last > first:
            node_count = 0
            for i in range(first, last + 1):
                if node_count > 0:
                    du = uv[i, 0] - nodes[node_count - 1, 0]
                    dv = uv[i, 1] - nodes[node_count - 1, 1]
                    if du * du + dv * dv < NODES_APART_CELLS * NODES_APART_CELLS:
                        if i < last:
                            continue
                        node_count = max(node_count - 1, 1)  # keep the end, drop the node before it
                nodes[node_count, 0] = uv[i, 0]
                nodes[node_count, 1] = uv[i, 1]
                node_count += 1
            blur_contour(nodes[:node_count], reach, level, settings, cells)
            mark_hits(uv[first : last + 1], level, settings, cells)
        elif settings.uses_lone_points:
            blur_point(uv[first, 0], uv[first, 1], level, settings, cells)
            mark_hits(uv[first : first + 1], level, settings, cells)
        first = last + 1
