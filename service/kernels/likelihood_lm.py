"""Levenberg-Marquardt on a likelihood map with the speed of the laser inside: every step deskews anew."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from service.kernels.deskew import deskew_points
from service.kernels.likelihood import read_field
from service.kernels.linear3 import copy_matrix, copy_vector, solve_3x3
from service.kernels.pose_information import add_prior, wrap

MOST_DAMPING = 1e6


class LmSettings(NamedTuple):
    """Documented where they are configured."""

    iterations: int  # I_max
    settled_m: float  # epsilon
    settled_rad: float
    first_damping: float
    estimates_velocity: bool


@njit(cache=True, nogil=True)
def log_motion(dx, dy, turn, motion):
    """Twist times duration that leads to a pose (dx, dy, turn) seen from the start.

    motion   (3,) float64   out: m forward, m left, rad
    Source: logarithm of SE(2) in closed form; paper 000, eq. 11.
    """
    half = 0.5 * turn
    k = 1.0 - half * half / 3.0 if abs(half) < 1e-4 else half / math.tan(half)
    motion[0] = k * dx + half * dy
    motion[1] = -half * dx + k * dy
    motion[2] = turn


@njit(cache=True, nogil=True)
def velocity_between(start, pose, elapsed_s, twist):
    """Constant body twist that leads from one pose to the next.

    start, pose   (3,) float64   m, m, rad in one frame
    elapsed_s     float          > 0
    twist         (3,) float64   out: m/s forward, m/s left, rad/s
    Source: paper 000, eq. 11: V = log(T_{t-1}^-1 T_t) / dt.
    """
    c = math.cos(start[2])
    s = math.sin(start[2])
    x = pose[0] - start[0]
    y = pose[1] - start[1]
    log_motion(c * x + s * y, -s * x + c * y, wrap(pose[2] - start[2]), twist)
    for k in range(3):
        twist[k] /= elapsed_s


@njit(cache=True, nogil=True)
def weighted_normal_equations(xy_base, values, weights, pose, inverse_variance, H, g):
    """Gauss-Newton system of sum w (1 - P)^2.

    xy_base            (N, 2) float64   m, base frame
    values             (N, 3) float64   from read_field at this pose
    weights            (N,)   float64
    pose               (3,)   float64   base in the frame of the map
    inverse_variance   float            of 1 - P, so that a prior can be weighed against it
    H, g               (3, 3), (3,) float64   out: Hessian, and gradient of half the cost, over x, y, theta
    Returns half the cost. Source: paper 000, eq. 8.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    cost = 0.0
    gx = gy = gt = 0.0
    hxx = hxy = hyy = hxt = hyt = htt = 0.0
    for i in range(xy_base.shape[0]):
        w = inverse_variance * weights[i]
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
    H[0, 0] = hxx
    H[0, 1] = H[1, 0] = hxy
    H[1, 1] = hyy
    H[0, 2] = H[2, 0] = hxt
    H[1, 2] = H[2, 1] = hyt
    H[2, 2] = htt
    return cost


@njit(cache=True, nogil=True)
def align_level(
    returns, weights, prior_pose, prior_information, start, elapsed_s, twist_gain, inverse_variance,
    tiles, field, cell_m, settings, xy_base, pose, twist, H,
):  # fmt: skip
    """Pose and speed of a scan on one level of a likelihood map.

    returns             Returns           end points at their own moments
    weights             (N,)   float64    from balance_weights
    prior_pose          (3,)   float64    predicted, and the information that is put on it: all zero for none
    prior_information   (3, 3) float64    in map axes
    start               (3,)   float64    pose of the scan before; with elapsed_s it makes a pose a speed
    elapsed_s           float             since then; 0: no speed can be learnt
    twist_gain          float             share of a change of the twist that is applied; 1: eq. 11
    inverse_variance    float             of 1 - P
    tiles, field, cell_m                  the level, as read_field takes it
    settings            LmSettings
    xy_base             (N, 2) float64    in: deskewed with twist; out: with the twist found
    pose                (3,)   float64    in: where to start; out: where it ended
    twist               (3,)   float64    in and out: m/s forward, m/s left, rad/s
    H                   (3, 3) float64    out: Hessian of the points alone
    Returns the number of steps that were taken.
    Source: paper 000, algorithm 1: one damped step, new speed, deskew anew, until the step is small.
    """
    values = np.empty((xy_base.shape[0], 3))
    g = np.empty(3)
    system = np.empty((3, 3))
    damped = np.empty((3, 3))
    step = np.empty(3)
    trial = np.empty(3)
    trial_H = np.empty((3, 3))
    trial_g = np.empty(3)
    damping = settings.first_damping
    before = twist.copy()
    moves = settings.estimates_velocity and elapsed_s > 0.0
    steps = 0
    for _ in range(settings.iterations):
        read_field(xy_base, 1, pose, tiles, field, cell_m, values)
        cost = weighted_normal_equations(xy_base, values, weights, pose, inverse_variance, H, g)
        copy_matrix(H, system)
        cost += 0.5 * add_prior(pose, prior_pose, prior_information, system, g)
        accepted = False
        while not accepted and damping <= MOST_DAMPING:
            copy_matrix(system, damped)
            for k in range(3):
                damped[k, k] += damping * (system[k, k] + 1e-9)
            if solve_3x3(damped, g, step):
                for k in range(3):
                    trial[k] = pose[k] - step[k]
                read_field(xy_base, 1, trial, tiles, field, cell_m, values)
                trial_cost = weighted_normal_equations(
                    xy_base, values, weights, trial, inverse_variance, trial_H, trial_g
                )
                trial_cost += 0.5 * add_prior(trial, prior_pose, prior_information, trial_H, trial_g)
                accepted = trial_cost < cost
            damping = max(0.1 * damping, 1e-6) if accepted else 10.0 * damping
        if not accepted:
            break
        copy_vector(trial, pose)
        steps += 1
        if moves:
            velocity_between(start, pose, elapsed_s, twist)
            for k in range(3):
                twist[k] = before[k] + twist_gain * (twist[k] - before[k])
            deskew_points(returns.xy_raw, returns.beam_time_s, twist, xy_base)
        if math.hypot(step[0], step[1]) < settings.settled_m and abs(step[2]) < settings.settled_rad:
            break
    pose[2] = wrap(pose[2])
    return steps
