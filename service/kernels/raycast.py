"""Ray casting against line segments and moving discs, with a uniform grid to skip empty space.

Each ray has its own origin, direction and time, so a sweep cast from a moving vehicle is distorted like a
real one. Source of the grid traversal: Amanatides, Woo, "A fast voxel traversal algorithm", Eurographics
1987.
"""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D, Int32_3D
from service.kernels.compiled import inner_kernel, kernel

NO_HIT = -1
CORNER_SLACK = 1e-9  # extension of a segment beyond its ends, in its own lengths: closes corners
BORDER_SLACK_M = (
    1e-6  # a segment this close to a cell belongs to it, so one on a border belongs to both cells
)


@inner_kernel
def _touches_cell(segment, left, bottom, cell_m):
    """Whether a segment (4,) comes within BORDER_SLACK_M of the square with this lower left corner."""
    t_in, t_out = 0.0, 1.0
    for axis in range(2):
        low = (left if axis == 0 else bottom) - BORDER_SLACK_M
        high = low + cell_m + 2.0 * BORDER_SLACK_M
        start, delta = segment[axis], segment[2 + axis] - segment[axis]
        if abs(delta) < 1e-12:
            if start < low or start > high:
                return False
            continue
        t_a, t_b = (low - start) / delta, (high - start) / delta
        t_in, t_out = max(t_in, min(t_a, t_b)), min(t_out, max(t_a, t_b))
    return t_in <= t_out


@kernel(Float64_2D, Float64_1D, int, int)
def index_segments(segments, grid_frame, rows, columns):
    """Sort segments into the cells of a grid.

    segments     (S, 4) float64   x0, y0, x1, y1 of each, m
    grid_frame   (3,)   float64   x and y of the lower left corner, edge of a cell; m
    rows, columns  int            the grid covers every segment
    Returns cell_span (rows, columns, 2) int32 and cell_items (K,) int32: the segments that touch a cell are
    cell_items[cell_span[row, column, 0] : cell_span[row, column, 1]].
    """
    x0, y0, cell_m = grid_frame
    cell_span = np.zeros((rows, columns, 2), dtype=np.int32)
    cell_items = np.empty(0, dtype=np.int32)
    for filling in (False, True):
        if filling:
            total = 0
            for row in range(rows):
                for column in range(columns):
                    count = cell_span[row, column, 1]
                    cell_span[row, column, 0] = cell_span[row, column, 1] = total
                    total += count
            cell_items = np.empty(total, dtype=np.int32)
        for i in range(segments.shape[0]):
            segment = segments[i]
            left, right = min(segment[0], segment[2]), max(segment[0], segment[2])
            low, high = min(segment[1], segment[3]), max(segment[1], segment[3])
            for row in range(
                max(0, int((low - y0 - BORDER_SLACK_M) / cell_m)),
                min(rows, int((high - y0 + BORDER_SLACK_M) / cell_m) + 1),
            ):
                for column in range(
                    max(0, int((left - x0 - BORDER_SLACK_M) / cell_m)),
                    min(columns, int((right - x0 + BORDER_SLACK_M) / cell_m) + 1),
                ):
                    if not _touches_cell(segment, x0 + column * cell_m, y0 + row * cell_m, cell_m):
                        continue
                    if filling:
                        cell_items[cell_span[row, column, 1]] = i
                    cell_span[row, column, 1] += 1
    return cell_span, cell_items


@inner_kernel
def _segment_distance(x, y, c, s, segment):
    """Distance along the ray from (x, y) in direction (c, s) to a segment (4,), m; inf: no hit."""
    ex, ey = segment[2] - segment[0], segment[3] - segment[1]
    cross = c * ey - s * ex
    if abs(cross) < 1e-12:
        return math.inf
    ax, ay = segment[0] - x, segment[1] - y
    along = (ax * ey - ay * ex) / cross
    share = (ax * s - ay * c) / cross
    if along < 0.0 or share < -CORNER_SLACK or share > 1.0 + CORNER_SLACK:
        return math.inf
    return along


@inner_kernel
def _disc_distance(x, y, c, s, time_s, disc):
    """Distance along the ray to a disc (5,) at that time, m; 0 from inside it, inf: no hit."""
    dx, dy = disc[0] + time_s * disc[2] - x, disc[1] + time_s * disc[3] - y
    outside = dx * dx + dy * dy - disc[4] * disc[4]
    if outside <= 0.0:
        return 0.0
    along = dx * c + dy * s
    square = along * along - outside
    if along <= 0.0 or square < 0.0:
        return math.inf
    return along - math.sqrt(square)


@inner_kernel
def _clip(start, delta, low, high, t_in, t_out):
    """The part of [t_in, t_out] for which low <= start + t * delta <= high."""
    if abs(delta) < 1e-12:
        return (t_in, t_out) if low <= start <= high else (t_in, -1.0)
    t_a, t_b = (low - start) / delta, (high - start) / delta
    return max(t_in, min(t_a, t_b)), min(t_out, max(t_a, t_b))


@inner_kernel
def _walk(x, y, c, s, segments, grid_frame, cell_span, cell_items, nearest_m):
    """Nearest segment on a ray closer than nearest_m: (distance in m, its index), or (nearest_m, NO_HIT)."""
    x0, y0, cell_m = grid_frame
    rows, columns = cell_span.shape[0], cell_span.shape[1]
    t_in, t_out = _clip(x, c, x0, x0 + columns * cell_m, 0.0, nearest_m)
    t_in, t_out = _clip(y, s, y0, y0 + rows * cell_m, t_in, t_out)
    hit = NO_HIT
    if t_in > t_out:
        return nearest_m, hit
    column = min(max(int((x + t_in * c - x0) / cell_m), 0), columns - 1)
    row = min(max(int((y + t_in * s - y0) / cell_m), 0), rows - 1)
    column_step, row_step = (1 if c > 0.0 else -1), (1 if s > 0.0 else -1)
    t_column = (x0 + (column + (c > 0.0)) * cell_m - x) / c if abs(c) > 1e-12 else math.inf
    t_row = (y0 + (row + (s > 0.0)) * cell_m - y) / s if abs(s) > 1e-12 else math.inf
    dt_column = cell_m / abs(c) if abs(c) > 1e-12 else math.inf
    dt_row = cell_m / abs(s) if abs(s) > 1e-12 else math.inf
    for _ in range(rows + columns):
        for k in range(cell_span[row, column, 0], cell_span[row, column, 1]):
            along = _segment_distance(x, y, c, s, segments[cell_items[k]])
            if along < nearest_m:
                nearest_m, hit = along, cell_items[k]
        if nearest_m <= min(t_column, t_row):
            break
        if t_column < t_row:
            column += column_step
            t_column += dt_column
        else:
            row += row_step
            t_row += dt_row
        if not (0 <= column < columns and 0 <= row < rows):
            break
    return nearest_m, hit


@kernel(Float64_2D, Float64_2D, Float64_2D, Float64_1D, Int32_3D, Int32_1D, float)
def cast_rays(rays, segments, discs, grid_frame, cell_span, cell_items, range_max_m):
    """Cast rays against segments and discs.

    rays         (N, 4) float64   x, y (m), direction (rad), time (s, on the discs' clock) of each
    segments     (S, 4) float64   x0, y0, x1, y1, m
    discs        (D, 5) float64   x, y at time 0 (m), speed in x and y (m/s), radius (m)
    grid_frame, cell_span, cell_items   arguments and results of index_segments
    range_max_m  float
    Returns range_m (N,) float64, inf: no hit, and hit (N,) int32: index of the segment, S + index of the
    disc, or NO_HIT. A ray that starts inside a disc hits it at 0.
    """
    count = rays.shape[0]
    range_m = np.full(count, np.inf)
    hit = np.full(count, NO_HIT, dtype=np.int32)
    for i in range(count):
        x, y, angle, time_s = rays[i]
        c, s = math.cos(angle), math.sin(angle)
        nearest_m, nearest = range_max_m, NO_HIT
        for k in range(discs.shape[0]):
            along = _disc_distance(x, y, c, s, time_s, discs[k])
            if along < nearest_m:
                nearest_m, nearest = along, segments.shape[0] + k
        along, segment = _walk(x, y, c, s, segments, grid_frame, cell_span, cell_items, nearest_m)
        if segment != NO_HIT:
            nearest_m, nearest = along, segment
        if nearest != NO_HIT:
            range_m[i], hit[i] = nearest_m, nearest
    return range_m, hit
