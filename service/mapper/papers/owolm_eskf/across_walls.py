"""Information of a scan on the map, across walls, and by its isolated points.

The map consists of points. Far along a corridor those of one scan are isolated, and the beams of the next
scan hit the same places. Where the pose lags behind, its points meet those of the previous scan:
the gradient along a wall then refers to the previous pose.
"""

import math

import numpy as np
import numpy.typing as npt

from service.kernels.blurred_segments import NO_SEGMENT
from service.kernels.likelihood_lm import likelihood_normal_equations
from service.kernels.normals import ROUGH_WEIGHT
from service.mapper.components import Points
from service.mapper.papers.owolm_eskf.building_axes import QUARTER_RAD
from service.mapper.walls import walls_of

Array = npt.NDArray[np.float64]

# Normals of short surfaces are off by 10 to 25 deg, so that one wall seems to fix the position along it. A
# direction is dropped if the points in no segment have less than this share of the information of the other.
MIN_SHARE = 0.2
BESIDE_M = 0.3  # distance from the line of a wall within which a point belongs to it, as a door or its frame
NEAR_AXIS_RAD = math.radians(15.0)  # walls follow the axes of the map: closer normals are set to an axis


def information_across(
    points: Points, values: Array, weights: Array, segment: npt.NDArray[np.int32], pose: Array
) -> Array:
    """(3, 3) information of x, y, theta in the axes of the map; zero in unobservable directions.

    values    (N, 3)   likelihood at each end point, and its gradient, 1/m, in the axes of the map
    weights   (N,)     of each point, over the variance of 1 - likelihood
    segment   (N, 2)   segments parallel to x and to y that each is in; NO_SEGMENT for none
    pose      (3,)     of the base in the axes of the map

    A point in a segment counts across it, another one along the normal of its surface. Points without a
    surface, such as single returns far along a wall, are left out.
    """
    sensor_xy_m = (points.sensor_base.x_m, points.sensor_base.y_m)
    step_rad = abs(points.scan.angle_step_rad)
    _, normals = walls_of(points.xy_base, sensor_xy_m, step_rad, points.range_sigma_m)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    across = _along_axes(normals[:, :2] @ np.array([[c, s], [-s, c]]))
    along_x, along_y = (segment != NO_SEGMENT).T
    slopes = values[:, 1:]
    of_segment = slopes * np.stack((along_y, along_x), axis=1)
    of_point = np.sum(slopes * across, axis=1)[:, None] * across
    is_point = (normals[:, 2] > ROUGH_WEIGHT) & ~(along_x | along_y)
    of_point = _without_weak_direction(of_point * is_point[:, None], weights)
    used = np.concatenate((values[:, :1], of_segment + of_point), axis=1)
    information = np.empty((3, 3))
    likelihood_normal_equations(points.xy_base, used, weights, pose, information, np.empty(3))
    return information


def information_of_dots(
    points: Points, values: Array, weights: Array, segment: npt.NDArray[np.int32], pose: Array
) -> Array:
    """The same; points beside no wall count in both directions: furniture, or a wall's far end."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    xy = points.xy_base @ np.array([[c, s], [-s, c]])
    along_x, along_y = (segment != NO_SEGMENT).T
    is_beside_x = along_x | _is_beside(xy[:, 1], segment[:, 0])
    is_beside_y = along_y | _is_beside(xy[:, 0], segment[:, 1])
    across = np.stack((along_y | ~is_beside_x, along_x | ~is_beside_y), axis=1)
    used = np.concatenate((values[:, :1], values[:, 1:] * across), axis=1)
    information = np.empty((3, 3))
    likelihood_normal_equations(points.xy_base, used, weights, pose, information, np.empty(3))
    return information


def _is_beside(across_m: Array, segment: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
    """(N,) whether a point is near the line of a segment; across_m: its coordinate across the segments."""
    lines_m = np.array([across_m[segment == k].mean() for k in np.unique(segment[segment != NO_SEGMENT])])
    is_beside: npt.NDArray[np.bool_] = (np.abs(across_m[:, None] - lines_m) < BESIDE_M).any(axis=1)
    return is_beside


def _without_weak_direction(slopes: Array, weights: Array) -> Array:
    information, axes = np.linalg.eigh((weights[:, None] * slopes).T @ slopes)
    if information[0] >= MIN_SHARE * information[1]:
        return slopes
    (strong,) = _along_axes(axes[None, :, 1])
    kept: Array = slopes @ np.outer(strong, strong)
    return kept


def _along_axes(directions: Array) -> Array:
    """Unit vectors (N, 2), those near an axis rotated onto it."""
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    axis = np.round(angle / QUARTER_RAD)
    is_near = np.abs(angle - axis * QUARTER_RAD) < NEAR_AXIS_RAD
    turned = np.array([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)])[axis.astype(np.int64) % 4]
    return np.where(is_near[:, None], turned, directions)
