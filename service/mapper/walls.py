"""The walls that the points of a scan lie on."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.kernels.normals import estimate_normals, move_along_walls

Floats = npt.NDArray[np.float64]


class Walls(NamedTuple):
    """What is known of each point.

    xy_base   (N, 2) m      moved along its wall to where its beam meets it, base frame
    normals   (N, 3)        unit normal towards the sensor, and the weight of the point; see estimate_normals
    """

    xy_base: Floats
    normals: Floats


def walls_of(
    xy_base: Floats,
    sensor_xy_m: tuple[float, float],
    angle_step_rad: float,
    range_sigma_m: float,
    grazing_weight: float = 1.0,
) -> Walls:
    """Of a scan's points, (N, 2) m in beam order; the others as estimate_normals takes them.

    Noise of a range moves a point along its beam: across its wall, which is measured, and along it, where the
    bearing says better where the point is; [24] of docs/estimator.md.
    """
    normals, aside_m = np.empty((len(xy_base), 3)), np.empty(len(xy_base))
    estimate_normals(
        xy_base, np.array(sensor_xy_m), angle_step_rad, range_sigma_m, grazing_weight, normals, aside_m
    )
    moved = np.empty_like(xy_base)
    move_along_walls(xy_base, normals, aside_m, moved)
    return Walls(moved, normals)
