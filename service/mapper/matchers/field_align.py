"""Alignment of points with a likelihood map, and its values there; not optimised for speed."""

import numpy as np

from service.geometry.poses import Floats
from service.kernels.likelihood import LikelihoodField, read_field
from service.kernels.likelihood_lm import LmSettings, align_points, likelihood_normal_equations


def align(
    xy: Floats,
    weights: Floats,
    prior: tuple[Floats, Floats],
    field: LikelihoodField,
    start: Floats,
    iterations: int,
) -> Floats:
    """The pose (3,) of a local maximum near `start`, its theta not wrapped.

    xy, weights   (N, 2) m, base frame, and (N,), from thin_evenly
    prior         pose (3,), and its information (3, 3) in the axes of the field
    iterations    upper bound; 0: none
    """
    pose, settings = start.copy(), LmSettings(iterations)
    align_points(
        xy, weights, *prior, field, settings, iterations, settings.first_damping, pose, np.empty((3, 3))
    )
    return pose


def values_at(xy: Floats, pose: Floats, field: LikelihoodField) -> Floats:
    """(N, 3): likelihood at points (N, 2) of the base frame, and its gradient in 1/m."""
    values = np.empty((len(xy), 3))
    read_field(xy, pose, field, values)
    return values


def information_at(xy: Floats, weights: Floats, pose: Floats, field: LikelihoodField) -> Floats:
    """(3, 3) of the points at a pose (3,), in the axes of the field."""
    information = np.empty((3, 3))
    values = values_at(xy, pose, field)
    likelihood_normal_equations(xy, values, weights, pose, information, np.empty(3))
    return information
