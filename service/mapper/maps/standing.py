"""A grid of how long cells around the vehicle are occupied, for display."""

import numpy as np

from service.mapper.components import Standing
from service.outputs import UNKNOWN, Grid, MapperOutput

SHOWN_REACH_M = 40.0  # around the vehicle; at 10 cm a cell, at most 640 000 cells


def draw_standing(standing: Standing, newest: MapperOutput) -> Grid | None:
    """A grid of the static score around the newest pose, per cent of the time after which it is full.

    Free cells are UNKNOWN. None where nothing is occupied within reach.
    """
    c, s = np.cos(newest.pose_map_odom.theta_rad), np.sin(newest.pose_map_odom.theta_rad)
    x_m = newest.pose_map_odom.x_m + c * standing.xy_odom[:, 0] - s * standing.xy_odom[:, 1]
    y_m = newest.pose_map_odom.y_m + s * standing.xy_odom[:, 0] + c * standing.xy_odom[:, 1]
    vehicle = newest.pose_map_base
    near = (np.abs(x_m - vehicle.x_m) < SHOWN_REACH_M) & (np.abs(y_m - vehicle.y_m) < SHOWN_REACH_M)
    if not near.any():
        return None
    column = np.floor(x_m[near] / standing.cell_m).astype(np.int64)
    row = np.floor(y_m[near] / standing.cell_m).astype(np.int64)
    first_column, first_row = int(column.min()), int(row.min())
    cells = np.full((int(row.max()) - first_row + 1, int(column.max()) - first_column + 1), UNKNOWN, np.int8)
    percent = np.maximum(np.rint(100.0 * standing.share[near]), 1.0).astype(np.int8)
    np.maximum.at(cells, (row - first_row, column - first_column), percent)
    cells.setflags(write=False)
    return Grid(0, standing.cell_m, first_column * standing.cell_m, first_row * standing.cell_m, cells)
