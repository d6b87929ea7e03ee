"""Background learning of a likelihood map: cells rise where hit and fall where beams pass through."""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.contour_blur import BLURRED, HIT, PASSED, LikelihoodLevel, ScanCells, touch_cell
from service.kernels.rays import begin_ray, next_cell
from service.kernels.surfels import TILE_BITS, TILE_MASK
from service.kernels.tiles import NO_TILE, find_tile

MAX_SEEN = 65_535
INTERPOLATION_SIGMAS = 3.0  # radius of the interpolation


class LearningSettings(NamedTuple):
    """Documented where they are configured."""

    rate: float  # w_l
    control: float  # tau
    protect_count: int  # n_th
    sigma_cells: float  # sigma_l
    is_printed: bool
    is_bounded: bool
    scans: int = 1  # number of scans this one stands for: it and those skipped before it


@kernel(Float64_2D, Float64_1D, Float64_1D, LikelihoodLevel, int, float, ScanCells)
def mark_passed(xy_base, sensor_xy_m, pose, level, protect_count, free_range_m, cells):
    """Add the cells that beams passed through before their end point to the scan's list, with value 0.

    xy_base         (N, 2) float64    end points, m, base frame
    sensor_xy_m     (2,)   float64    start of the beams, m, base frame
    pose            (3,)   float64    base in the frame of the map
    level           LikelihoodLevel   in and out: marks
    protect_count   int               cells seen in more scans are skipped, as are those of likelihood 0
    free_range_m    float             length up to which beams are traced
    cells           ScanCells         in: from blur_scan; out: with the cells passed
    Cells already on the list are unchanged: no beam clears what the scan hits.
    Source: Amanatides and Woo 1987.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    cells_per_m = 1.0 / level.cell_m
    u = (pose[0] + c * sensor_xy_m[0] - s * sensor_xy_m[1]) * cells_per_m
    v = (pose[1] + s * sensor_xy_m[0] + c * sensor_xy_m[1]) * cells_per_m
    likelihood = level.likelihood
    for i in range(xy_base.shape[0]):
        du = (pose[0] + c * xy_base[i, 0] - s * xy_base[i, 1]) * cells_per_m - u
        dv = (pose[1] + s * xy_base[i, 0] + c * xy_base[i, 1]) * cells_per_m - v
        shrink = min(1.0, free_range_m * cells_per_m / max(math.hypot(du, dv), 1e-9))
        du *= shrink
        dv *= shrink
        column, row, step_column, step_row, next_column, next_row, per_column, per_row, count = begin_ray(
            u, v, du, dv
        )
        tile_row = row >> TILE_BITS
        tile_column = column >> TILE_BITS
        slot = find_tile(level.tiles, tile_row, tile_column)
        for _ in range(count):
            if row >> TILE_BITS != tile_row or column >> TILE_BITS != tile_column:
                tile_row = row >> TILE_BITS
                tile_column = column >> TILE_BITS
                slot = find_tile(level.tiles, tile_row, tile_column)
            if slot != NO_TILE:
                r = row & TILE_MASK
                q = column & TILE_MASK
                if likelihood[slot, r, q] > 0.0 and level.seen[slot, r, q] <= protect_count:
                    touch_cell(level, row, column, cells)
            column, row, next_column, next_row = next_cell(
                column, row, step_column, step_row, next_column, next_row, per_column, per_row
            )


@inner_kernel
def kept_rising(highest, settings):
    """Factor on the old likelihood of a rising cell. Source: Li et al. 2016, eq. 14: 1 - w_u."""
    return (1.0 - settings.rate * (1.0 + settings.control * highest)) ** settings.scans


@inner_kernel
def kept_falling(highest, settings):
    """Factor on the old likelihood of a falling cell. Source: Li et al. 2016, eq. 16: 1 - w_d."""
    return (1.0 - settings.rate / (1.0 + settings.control * highest)) ** settings.scans


@inner_kernel
def averaged(likelihood, highest, value, settings):
    """Likelihood of a cell beside a hit, averaged with that of the scan: rate w_u upwards, w_d downwards.

    Range noise moves the hits of a wall between neighbouring cells. With w_u in both directions the cell
    beside would fall 16 times as fast as an unseen one (tau = 3).
    """
    kept = kept_rising(highest, settings) if value > likelihood else kept_falling(highest, settings)
    return kept * likelihood + (1.0 - kept) * value


@inner_kernel
def increase(likelihood, highest, value, settings):
    """Likelihood of a cell hit by a scan of likelihood `value`.

    Source: Li et al. 2016, eqs. 13 and 14. Without settings.is_printed the max() with the scan is left out:
    with it a single hit counts fully, and noise makes a wall as thick as in the worst scan.
    """
    base = max(likelihood, value) if settings.is_printed else likelihood
    return 1.0 - kept_rising(highest, settings) * (1.0 - base)


@inner_kernel
def decrease(likelihood, highest, settings):
    """Likelihood of a cell in which nothing was seen. Source: Li et al. 2016, eqs. 15 and 16."""
    return kept_falling(highest, settings) * likelihood


@inner_kernel
def store(level, slot, r, q, likelihood, scans):
    """Store the new likelihood of a cell, update its maximum and its scan count."""
    level.likelihood[slot, r, q] = np.float32(likelihood)
    level.highest[slot, r, q] = max(level.highest[slot, r, q], np.float32(likelihood))
    level.seen[slot, r, q] = np.uint16(min(level.seen[slot, r, q] + scans, MAX_SEEN))


@inner_kernel
def listed(level, row, column):
    """Row of a cell in the scan's list, -1 where it is absent."""
    slot = find_tile(level.tiles, row >> TILE_BITS, column >> TILE_BITS)
    if slot == NO_TILE:
        return np.int64(-1)
    return np.int64(level.mark[slot, row & TILE_MASK, column & TILE_MASK]) - 1


@inner_kernel
def rise_at(level, k, old, settings, cells):
    """p_u of a cell, interpolated from the nearest hits.

    Source: Li et al. 2016, eq. 17, a maximum where argmax is printed.
    k     int     its row in the list
    old   float   its likelihood before
    """
    radius = INTERPOLATION_SIGMAS * settings.sigma_cells
    reach = math.floor(radius)
    best = 0.0
    found = False
    for v in range(-reach, reach + 1):
        for u in range(-reach, reach + 1):
            if u * u + v * v > radius * radius:
                continue
            i = listed(level, cells.place[k, 1] + v, cells.place[k, 2] + u)
            if i < 0 or cells.kind[i] != HIT:
                continue
            slot, row, column = cells.place[i, 0], cells.place[i, 1], cells.place[i, 2]
            new = np.float64(level.likelihood[slot, row & TILE_MASK, column & TILE_MASK])
            change = (new - old) * math.exp(-math.sqrt(u * u + v * v) / settings.sigma_cells)
            if not found or change > best:
                best = change
                found = True
    return best


@inner_kernel
def spread_falls(level, settings, cells):
    """Fill p_d of the blurred cells. Source: Li et al. 2016, eq. 17: the most negative."""
    radius = INTERPOLATION_SIGMAS * settings.sigma_cells
    reach = math.floor(radius)
    for i in range(cells.rows[0]):
        if cells.kind[i] != PASSED:
            continue
        slot, row, column = cells.place[i, 0], cells.place[i, 1], cells.place[i, 2]
        new = np.float64(level.likelihood[slot, row & TILE_MASK, column & TILE_MASK])
        for v in range(-reach, reach + 1):
            for u in range(-reach, reach + 1):
                if u * u + v * v > radius * radius:
                    continue
                k = listed(level, row + v, column + u)
                if k < 0 or cells.kind[k] != BLURRED:
                    continue
                r, q = (row + v) & TILE_MASK, (column + u) & TILE_MASK
                change = new - np.float64(level.likelihood[cells.place[k, 0], r, q])
                change *= math.exp(-math.sqrt(u * u + v * v) / settings.sigma_cells)
                cells.fall[k] = min(cells.fall[k], np.float32(change))


@kernel(LikelihoodLevel, LearningSettings, ScanCells)
def learn_scan(level, settings, cells):
    """Update the map with the cells of one scan.

    level      LikelihoodLevel   in and out
    settings   LearningSettings
    cells      ScanCells         from blur_scan and mark_passed, all rows present
    A cell seen for the first time takes the scan's likelihood. Others rise where hit and fall where passed. A
    blurred cell is interpolated between those (as printed), or averaged with the scan's likelihood.
    Source: Li et al. 2016, section 2.4, eqs. 13 to 18.
    """
    for k in range(cells.rows[0]):
        slot, r, q = cells.place[k, 0], cells.place[k, 1] & TILE_MASK, cells.place[k, 2] & TILE_MASK
        old = np.float64(level.likelihood[slot, r, q])
        highest = np.float64(level.highest[slot, r, q])
        if cells.kind[k] == HIT:
            new = np.float64(cells.value[k])
            if level.seen[slot, r, q] > 0:
                new = increase(old, highest, new, settings)
            store(level, slot, r, q, new, settings.scans)
        elif cells.kind[k] == PASSED:
            level.likelihood[slot, r, q] = np.float32(decrease(old, highest, settings))
    if settings.is_printed:
        spread_falls(level, settings, cells)
    for k in range(cells.rows[0]):
        if cells.kind[k] != BLURRED:
            continue
        value = np.float64(cells.value[k])
        slot, r, q = cells.place[k, 0], cells.place[k, 1] & TILE_MASK, cells.place[k, 2] & TILE_MASK
        if level.seen[slot, r, q] == 0:
            store(level, slot, r, q, value, settings.scans)
            continue
        old = np.float64(level.likelihood[slot, r, q])
        if settings.is_printed:
            new = interpolated(level, k, old, value, settings, cells)
        else:
            new = averaged(old, np.float64(level.highest[slot, r, q]), value, settings)
        store(level, slot, r, q, new, settings.scans)


@inner_kernel
def interpolated(level, k, old, value, settings, cells):
    """Likelihood of a cell that is blurred by a scan but not hit. Source: Li et al. 2016, eqs. 17 and 18.

    k       int     its row in the list, p_d filled in
    old     float   its likelihood before
    value   float   that in the scan's own map, with settings.is_bounded an upper bound
    """
    rise = 0.0
    if old < (value if settings.is_bounded else 1.0):
        rise = rise_at(level, k, old, settings, cells)
    fall = np.float64(cells.fall[k])
    if abs(rise) <= abs(fall):
        return max(old + fall, 0.0)
    new = min(old + rise, 1.0)
    return max(old, min(new, value)) if settings.is_bounded else new
