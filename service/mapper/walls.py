"""Walls at the points of a scan."""

import numpy as np
import numpy.typing as npt

from service.kernels.normals import estimate_normals

Floats = npt.NDArray[np.float64]


def walls_of(
    xy_base: Floats, sensor_xy_m: tuple[float, float], angle_step_rad: float, range_sigma_m: float
) -> tuple[Floats, Floats]:
    """The points (N, 2) m of a scan, moved along their walls onto their beams; (N, 3) of estimate_normals.

    Range noise moves a point along its beam. Its component across the wall is a measurement error; along
    the wall the bearing is more precise, so the point is moved there; [24] of docs/estimator.md.
    """
    normals, moved = np.empty((len(xy_base), 3)), np.empty_like(xy_base)
    sensor = np.array(sensor_xy_m)
    estimate_normals(xy_base, sensor, angle_step_rad, range_sigma_m, 1.0, normals, moved)
    return moved, normals
