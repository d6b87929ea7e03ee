"""Scan to likelihood field by Levenberg-Marquardt: what leads where surfels are too far off."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from service.kernels.likelihood import read_field
from service.kernels.linear3 import copy_matrix, copy_vector, solve_3x3
from service.kernels.pose_information import add_prior


class AlignSettings(NamedTuple):
    """How coarse_align lays a scan on a likelihood field."""

    sigma: float  # of 1 - likelihood
    beams: int  # about so many are asked
    iterations: int


@njit(cache=True, nogil=True)
def coarse_normal_equations(xy_base, values, stride, pose, sigma, H, g):
    """Gauss-Newton system of 1 - likelihood over every stride-th point, weighed as if all had been asked.

    xy_base   (N, 2) float64    m, base frame
    values    (N, 3) float64    from read_field at this pose
    stride    int
    pose      (3,)   float64    base in the frame of the field
    sigma     float             of 1 - likelihood
    H, g      (3, 3), (3,) float64   out: Hessian, and gradient of half the cost, over x, y, theta
    Returns half the cost.
    Source: Kohlbrecher et al. 2011, eqs. (7) to (13).
    """
    H[:] = 0.0
    g[:] = 0.0
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    weight = stride / (sigma * sigma)
    cost = 0.0
    for i in range(0, xy_base.shape[0], stride):
        e = 1.0 - values[i, 0]
        sx = values[i, 1]
        sy = values[i, 2]
        cost += 0.5 * weight * e * e
        st = sy * (c * xy_base[i, 0] - s * xy_base[i, 1]) - sx * (s * xy_base[i, 0] + c * xy_base[i, 1])
        g[0] -= weight * e * sx
        g[1] -= weight * e * sy
        g[2] -= weight * e * st
        H[0, 0] += weight * sx * sx
        H[1, 0] += weight * sx * sy
        H[1, 1] += weight * sy * sy
        H[2, 0] += weight * sx * st
        H[2, 1] += weight * sy * st
        H[2, 2] += weight * st * st
    H[0, 1] = H[1, 0]
    H[0, 2] = H[2, 0]
    H[1, 2] = H[2, 1]
    return cost


@njit(cache=True, nogil=True)
def coarse_align(xy_base, prior_pose, information, field, settings, pose):
    """Levenberg-Marquardt on the likelihood field, held by the prior.

    xy_base       (N, 2) float64   m, base frame
    prior_pose    (3,)   float64
    information   (3, 3) float64   of the prior, in the axes of the field
    field         LikelihoodField
    settings      AlignSettings
    pose          (3,)   float64   in: where to start; out: where it ended
    """
    stride = max(1, xy_base.shape[0] // settings.beams)
    values = np.empty((xy_base.shape[0], 3))
    H = np.empty((3, 3))
    g = np.empty(3)
    damped = np.empty((3, 3))
    step = np.empty(3)
    trial = np.empty(3)
    trial_H = np.empty((3, 3))
    trial_g = np.empty(3)
    damping = 1e-3
    read_field(xy_base, stride, pose, field.tiles, field.field, field.cell_m, values)
    cost = coarse_normal_equations(xy_base, values, stride, pose, settings.sigma, H, g)
    cost += 0.5 * add_prior(pose, prior_pose, information, H, g)
    for _ in range(settings.iterations):
        for i in range(3):
            for j in range(3):
                damped[i, j] = H[i, j]
            damped[i, i] += damping * H[i, i]
        if not solve_3x3(damped, g, step):
            return
        for i in range(3):
            trial[i] = pose[i] - step[i]
        read_field(xy_base, stride, trial, field.tiles, field.field, field.cell_m, values)
        trial_cost = coarse_normal_equations(xy_base, values, stride, trial, settings.sigma, trial_H, trial_g)
        trial_cost += 0.5 * add_prior(trial, prior_pose, information, trial_H, trial_g)
        if not trial_cost < cost:  # NaN too
            damping *= 10.0
            if damping > 1e3:
                return
            continue
        copy_vector(trial, pose)
        copy_matrix(trial_H, H)
        copy_vector(trial_g, g)
        cost = trial_cost
        damping = max(0.1 * damping, 1e-6)
        if math.hypot(step[0], step[1]) < 1e-3 and abs(step[2]) < 1e-4:
            return
