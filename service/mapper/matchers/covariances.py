"""Covariances (3, 3) of x, y, theta that a match is said to have."""

import math

import numpy as np

from service.geometry.poses import Floats


def diagonal(position_m: float, heading_rad: float) -> Floats:
    """Of a place known to so many m each way, and a heading known to so many rad (sigmas)."""
    return np.diag([position_m**2, position_m**2, heading_rad**2])


def inverse(matrix: Floats) -> Floats:
    """Information of a covariance, or the other way round. Raises LinAlgError where it is singular."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


def in_base_axes(covariance_map: Floats, theta_rad: float) -> Floats:
    """A covariance in the axes of the map, in those of a base that is turned by theta_rad in it."""
    c, s = math.cos(theta_rad), math.sin(theta_rad)
    base_from_map = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    turned: Floats = base_from_map @ covariance_map @ base_from_map.T
    return turned
