"""Traversal of the cells along a beam."""

import math

import numpy as np

from service.kernels.compiled import inlined_kernel, inner_kernel

BEHIND_M = 0.3  # what a beam passes lies at least this far before its end


@inner_kernel
def begin_ray(u, v, du, dv):
    """Start and increments of the traversal of the cells between two points.

    u, v     float   start, in cells
    du, dv   float   from start to end, in cells
    Returns (column, row, step_column, step_row of int; next_column, next_row, per_column, per_row of float;
    count of int). next_* is the ray parameter, 0 at the start and 1 at the end, at the next vertical and
    horizontal border, per_* its increment from one such border to the next. The end is reached after count
    steps of next_cell.
    Source: Amanatides and Woo, A fast voxel traversal algorithm for ray tracing, 1987.
    """
    column = math.floor(u)
    row = math.floor(v)
    next_column = ((column + 1 if du > 0.0 else column) - u) / du if du != 0.0 else np.inf
    next_row = ((row + 1 if dv > 0.0 else row) - v) / dv if dv != 0.0 else np.inf
    per_column = abs(1.0 / du) if du != 0.0 else np.inf
    per_row = abs(1.0 / dv) if dv != 0.0 else np.inf
    count = abs(math.floor(u + du) - column) + abs(math.floor(v + dv) - row)
    step_column = 1 if du > 0.0 else -1
    step_row = 1 if dv > 0.0 else -1
    return column, row, step_column, step_row, next_column, next_row, per_column, per_row, count


@inlined_kernel
def next_cell(column, row, step_column, step_row, next_column, next_row, per_column, per_row):
    """One step of the traversal. Returns (column, row, next_column, next_row).

    Without branches: which border comes first cannot be predicted.
    """
    is_column = next_column < next_row
    return (
        column + (step_column if is_column else 0),
        row + (0 if is_column else step_row),
        next_column + (per_column if is_column else 0.0),
        next_row + (0.0 if is_column else per_row),
    )
