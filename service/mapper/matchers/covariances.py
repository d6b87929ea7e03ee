"""Covariances (3, 3) of x, y, theta."""

import numpy as np

from service.geometry.poses import Floats, rotated


def diagonal(position_m: float, heading_rad: float) -> Floats:
    """Diagonal covariance by the sigmas of position and heading."""
    return np.diag([position_m**2, position_m**2, heading_rad**2])


def inverse(matrix: Floats) -> Floats:
    """Inverse of a covariance or information matrix. Raises LinAlgError where it is singular."""
    return np.asarray(np.linalg.inv(matrix), np.float64)


def in_base_axes(covariance_map: Floats, theta_rad: float) -> Floats:
    """A covariance in map axes, transformed to the axes of a base at heading theta_rad."""
    return rotated(covariance_map, -theta_rad)
