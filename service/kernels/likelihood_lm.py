"""Levenberg-Marquardt on a likelihood map, used by all matchers with such a map."""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import kernel
from service.kernels.likelihood import LikelihoodField, read_field
from service.kernels.linear3 import copy_matrix, copy_vector, fill_symmetric, solve_3x3
from service.kernels.pose_information import add_prior

MIN_DAMPING = 1e-6  # of Levenberg-Marquardt


class LmSettings(NamedTuple):
    """End and damping of a descent.

    trials                        int     most systems solved
    settled_m, settled_rad        float   a step below both is the last
    first_damping, most_damping   float   the descent ends above the largest damping
    floor                         float   added to the damped diagonal: directions without information stay
    """

    trials: int
    settled_m: float = 1e-3
    settled_rad: float = 1e-4
    first_damping: float = 1e-3
    most_damping: float = 1e3
    floor: float = 0.0


@kernel(Float64_2D, int, float)
def thin_evenly(xy_base, beams, sigma):
    """About `beams` of the points, evenly chosen, with weights that sum as for all of them.

    xy_base   (N, 2) float64   m
    beams     int              > 0
    sigma     float            of 1 - likelihood
    Returns (every k-th point (M, 2), weights (M,)) float64.
    """
    stride = max(1, xy_base.shape[0] // beams)
    count = (xy_base.shape[0] + stride - 1) // stride
    thin = np.empty((count, 2))
    weights = np.empty(count)
    for i in range(count):
        thin[i, 0] = xy_base[i * stride, 0]
        thin[i, 1] = xy_base[i * stride, 1]
        weights[i] = stride / (sigma * sigma)
    return thin, weights


@kernel(Float64_2D, Float64_2D, Float64_1D, Float64_1D, Float64_2D, Float64_1D)
def likelihood_normal_equations(xy_base, values, weights, pose, H, g):
    """Gauss-Newton system of sum w (1 - P)^2.

    xy_base   (N, 2) float64   m, base frame
    values    (N, 3) float64   from read_field at this pose
    weights   (N,)   float64   of each point, over the variance of 1 - P
    pose      (3,)   float64   base in the frame of the map
    H, g      (3, 3), (3,) float64   out: Hessian, and gradient of half the cost, over x, y, theta
    Returns half the cost.
    Source: Kohlbrecher et al. 2011, eqs. (7) to (13); Li et al. 2016, eq. 8.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    cost = 0.0
    gx = gy = gt = 0.0
    hxx = hxy = hyy = hxt = hyt = htt = 0.0
    for i in range(xy_base.shape[0]):
        w = weights[i]
        e = 1.0 - values[i, 0]
        cost += 0.5 * w * e * e
        sx = values[i, 1]
        sy = values[i, 2]
        st = sy * (c * xy_base[i, 0] - s * xy_base[i, 1]) - sx * (s * xy_base[i, 0] + c * xy_base[i, 1])
        gx -= w * e * sx
        gy -= w * e * sy
        gt -= w * e * st
        hxx += w * sx * sx
        hxy += w * sx * sy
        hyy += w * sy * sy
        hxt += w * sx * st
        hyt += w * sy * st
        htt += w * st * st
    g[0] = gx
    g[1] = gy
    g[2] = gt
    fill_symmetric(H, hxx, hxy, hyy, hxt, hyt, htt)
    return cost


@kernel(
    Float64_2D,
    Float64_1D,
    Float64_1D,
    Float64_2D,
    LikelihoodField,
    LmSettings,
    int,
    float,
    Float64_1D,
    Float64_2D,
)
def align_points(
    xy_base, weights, prior_pose, prior_information, field, settings, most_steps, damping, pose, H
):  # fmt: skip
    """Align points with a likelihood map, with a prior.

    xy_base             (N, 2) float64    m, base frame
    weights             (N,)   float64    as for likelihood_normal_equations
    prior_pose          (3,)   float64
    prior_information   (3, 3) float64    in the axes of the map; all zero for no prior
    field               LikelihoodField
    settings            LmSettings
    most_steps          int               upper bound
    damping             float             initial; may continue from a previous call
    pose                (3,)   float64    in: initial; out: final, theta not wrapped
    H                   (3, 3) float64    out: Hessian of the points alone, at the initial pose
    Returns (steps taken, whether it converged, final damping).
    """
    values = np.empty((xy_base.shape[0], 3))
    g = np.empty(3)
    system = np.empty((3, 3))
    damped = np.empty((3, 3))
    step = np.empty(3)
    trial = np.empty(3)
    trial_system = np.empty((3, 3))
    trial_g = np.empty(3)
    read_field(xy_base, pose, field, values)
    cost = likelihood_normal_equations(xy_base, values, weights, pose, H, g)
    copy_matrix(H, system)
    cost += 0.5 * add_prior(pose, prior_pose, prior_information, system, g)
    steps = 0
    is_settled = False
    for _ in range(settings.trials):
        copy_matrix(system, damped)
        for k in range(3):
            damped[k, k] += damping * (system[k, k] + settings.floor)
        trial_cost = np.inf
        if solve_3x3(damped, g, step):
            for k in range(3):
                trial[k] = pose[k] - step[k]
            read_field(xy_base, trial, field, values)
            trial_cost = likelihood_normal_equations(xy_base, values, weights, trial, trial_system, trial_g)
            trial_cost += 0.5 * add_prior(trial, prior_pose, prior_information, trial_system, trial_g)
        if not trial_cost < cost:  # NaN too
            damping *= 10.0
            if damping > settings.most_damping:
                break
            continue
        copy_vector(trial, pose)
        copy_matrix(trial_system, system)
        copy_vector(trial_g, g)
        cost = trial_cost
        damping = max(0.1 * damping, MIN_DAMPING)
        steps += 1
        is_settled = math.hypot(step[0], step[1]) < settings.settled_m and abs(step[2]) < settings.settled_rad
        if is_settled or steps == most_steps:
            break
    return steps, is_settled, damping
