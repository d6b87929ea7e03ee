"""Scan to sub-map: Gauss-Newton on surfels, deskewing anew between; a coarse map leads where that fails."""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from service.kernels.coarse_align import AlignSettings, coarse_align
from service.kernels.deskew import deskew_points
from service.kernels.likelihood import LikelihoodField
from service.kernels.linear3 import copy_matrix, copy_vector, solve_3x3
from service.kernels.pose_information import (
    add_prior,
    invert_3x3,
    rotate_information,
    weakest_direction,
    wrap,
)
from service.kernels.surfels import find_surfels

HOLD_INFORMATION = 1e6  # 1/m^2: to a millimetre


class Prior(NamedTuple):
    """Where the base should be. Covariances in base axes of the predicted pose, theta last."""

    pose: npt.NDArray[np.float64]  # (3,) m, m, rad in the frame of the grid
    twist: npt.NDArray[np.float64]  # (3,) m/s forward, m/s left, rad/s
    step_covariance: npt.NDArray[np.float64]  # (3, 3) of the motion since the last match
    covariance: npt.NDArray[np.float64]  # (3, 3) of the pose
    elapsed_s: float  # since the last match; 0: no twist can be learnt from this one
    twist_gain: float  # share of a correction of the pose that is put down to the twist
    is_measured: bool  # wheels measured the way since the last match


class MatchSettings(NamedTuple):
    """Documented where they are configured."""

    sigma_m: float
    cauchy_m: float
    least_normal_cosine: float
    young_count: float
    iterations: int
    deskew_rounds: int
    inlier_m: float
    coarse_sigma: float
    coarse_beams: int
    coarse_iterations: int
    settled_m: float
    settled_rad: float
    blind_sigma_m: float
    covariance_scale: float


class MatchResult(NamedTuple):
    pose: npt.NDArray[np.float64]  # (3,)
    twist: npt.NDArray[np.float64]  # (3,)
    covariance: npt.NDArray[np.float64]  # (3, 3) of the pose, in its base axes
    share: float  # of the points used that lie on the map
    used: int  # points that were asked
    weakest_sigma_m: (
        float  # standard deviation along the direction that the scan fixes least; inf: not at all
    )
    weakest_direction_rad: float  # that direction, in base axes
    information: npt.NDArray[np.float64]  # (3, 3) of the points alone, in base axes, settings.sigma_m a beam
    residual_m: float  # weighted RMS distance of the points from their surfels


@njit(cache=True, nogil=True)
def surfel_cost(xy_base, normals, found, pose, unmatched_m, settings):
    """Half the cost whose gradient surfel_normal_equations gives; apart, for its logarithms take as long.

    unmatched_m   float             a point without a surfel costs as much as one that is so far off
    The others    as there.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    squared_cauchy = settings.cauchy_m * settings.cauchy_m
    unmatched = 0.5 * squared_cauchy * math.log1p(unmatched_m * unmatched_m / squared_cauchy)
    cost = 0.0
    for i in range(xy_base.shape[0]):
        weight = normals[i, 2]
        if weight == 0.0:
            continue
        if found[i, 4] == 0.0:
            cost += weight * unmatched
            continue
        rx = c * xy_base[i, 0] - s * xy_base[i, 1]
        ry = s * xy_base[i, 0] + c * xy_base[i, 1]
        e = found[i, 2] * (pose[0] + rx - found[i, 0]) + found[i, 3] * (pose[1] + ry - found[i, 1])
        weight *= min(1.0, found[i, 4] / settings.young_count)
        cost += 0.5 * weight * squared_cauchy * math.log1p(e * e / squared_cauchy)
    return cost * (1.0 / (settings.sigma_m * settings.sigma_m))


@njit(cache=True, nogil=True)
def surfel_normal_equations(xy_base, normals, found, pose, settings, H, g):
    """Gauss-Newton system of the distances, along the surfels' normals, between points and their surfels.

    xy_base       (N, 2) float64    m, base frame
    normals       (N, 3) float64    from estimate_normals
    found         (N, 5) float64    from find_surfels
    pose          (3,)   float64    base in the frame of the surfels
    settings      MatchSettings
    H, g          (3, 3), (3,) float64   out: Hessian, and gradient of half the cost, over x, y, theta
    Returns (points asked, points within settings.inlier_m, weighted mean of e^2 in m^2).
    Source: point-to-line ICP, Censi 2008; Cauchy weight 1 / (1 + e^2 / c^2).
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    squared_cauchy = settings.cauchy_m * settings.cauchy_m
    scale = 1.0 / (settings.sigma_m * settings.sigma_m)
    used = 0
    inliers = 0
    total_weight = squares = 0.0
    gx = gy = gt = 0.0
    hxx = hxy = hyy = hxt = hyt = htt = 0.0
    for i in range(xy_base.shape[0]):
        weight = normals[i, 2]
        if weight == 0.0:
            continue
        used += 1
        if found[i, 4] == 0.0:
            continue
        nx = found[i, 2]
        ny = found[i, 3]
        rx = c * xy_base[i, 0] - s * xy_base[i, 1]
        ry = s * xy_base[i, 0] + c * xy_base[i, 1]
        e = nx * (pose[0] + rx - found[i, 0]) + ny * (pose[1] + ry - found[i, 1])
        if abs(e) < settings.inlier_m:
            inliers += 1
        weight *= min(1.0, found[i, 4] / settings.young_count)
        ratio = e * e / squared_cauchy
        weight /= 1.0 + ratio
        total_weight += weight
        squares += weight * e * e
        jt = ny * rx - nx * ry
        gx += weight * e * nx
        gy += weight * e * ny
        gt += weight * e * jt
        hxx += weight * nx * nx
        hxy += weight * nx * ny
        hyy += weight * ny * ny
        hxt += weight * nx * jt
        hyt += weight * ny * jt
        htt += weight * jt * jt
    g[0] = scale * gx
    g[1] = scale * gy
    g[2] = scale * gt
    H[0, 0] = scale * hxx
    H[0, 1] = H[1, 0] = scale * hxy
    H[1, 1] = scale * hyy
    H[0, 2] = H[2, 0] = scale * hxt
    H[1, 2] = H[2, 1] = scale * hyt
    H[2, 2] = scale * htt
    return used, inliers, squares / max(total_weight, 1e-9)


@njit(cache=True, nogil=True)
def learn_twist(prior, pose, twist):
    """Twist that explains where the match ended, starting from the prior's.

    prior   Prior
    pose    (3,) float64   matched
    twist   (3,) float64   out
    """
    c = math.cos(prior.pose[2])
    s = math.sin(prior.pose[2])
    dx = pose[0] - prior.pose[0]
    dy = pose[1] - prior.pose[1]
    gain = prior.twist_gain / prior.elapsed_s if prior.elapsed_s > 0.0 else 0.0
    twist[0] = prior.twist[0] + gain * (c * dx + s * dy)
    twist[1] = prior.twist[1] + gain * (-s * dx + c * dy)
    twist[2] = prior.twist[2] + gain * wrap(pose[2] - prior.pose[2])


@njit(cache=True, nogil=True)
def hold_blind_direction(pose, prior, H, settings, system, g):
    """Leave the direction that the points fix least to the prediction, where they hardly fix it at all.

    What they say of it then is noise of the map, which pulls once and for all the same way. A prediction
    that nobody measured is no better, it would roll on for ever: there the points keep the little they say.

    pose        (3,)   float64
    prior       Prior
    H           (3, 3) float64   Hessian of the points alone
    settings    MatchSettings
    system, g   (3, 3), (3,) float64   in and out: Hessian, and gradient of half the cost
    Source: Zhang, Kaess, Singh, On degeneracy of optimization-based state estimation problems, 2016.
    """
    if not prior.is_measured:
        return
    least, direction = weakest_direction(H)
    if least * settings.blind_sigma_m * settings.blind_sigma_m >= settings.covariance_scale:
        return
    vx = math.cos(direction)
    vy = math.sin(direction)
    away = vx * (pose[0] - prior.pose[0]) + vy * (pose[1] - prior.pose[1])
    system[0, 0] += HOLD_INFORMATION * vx * vx
    system[0, 1] += HOLD_INFORMATION * vx * vy
    system[1, 0] += HOLD_INFORMATION * vx * vy
    system[1, 1] += HOLD_INFORMATION * vy * vy
    g[0] += HOLD_INFORMATION * away * vx
    g[1] += HOLD_INFORMATION * away * vy


@njit(cache=True, nogil=True)
def fine_align(returns, normals, prior, prior_information, grid, settings, doubt_share, xy_base, pose, H):
    """Gauss-Newton on surfels, held by the prior, deskewing anew with the twist that each step finds.

    returns             Returns            end points at their own moments
    normals             (N, 3) float64     base frame
    prior               Prior
    prior_information   (3, 3) float64     of the step, in the axes of the grid
    grid                SurfelGrid
    settings            MatchSettings
    doubt_share         float              the cost is asked with fewer points than that on the map, else 0
    xy_base             (N, 2) float64     in: deskewed with the prior's twist; out: with the matched one
    pose                (3,)   float64     in: where to start; out: where it ended
    H                   (3, 3) float64     out: Hessian of the points alone
    Returns (half the cost before the last step, of points and prior; points asked; points that lie on the
    map; weighted mean of their squared distances in m^2).
    """
    g = np.empty(3)
    step = np.empty(3)
    twist = np.empty(3)
    system = np.empty((3, 3))
    count = xy_base.shape[0]
    found = np.empty((count, 5))
    asked = np.empty(3)
    moves = count > 0 and returns.beam_time_s[count - 1] > 0.0 and prior.elapsed_s > 0.0
    cost = 0.0
    used = 0
    inliers = 0
    squared_m2 = 0.0
    for k in range(settings.iterations + 1):
        if moves and 0 < k <= settings.deskew_rounds:
            learn_twist(prior, pose, twist)
            deskew_points(returns.xy_raw, returns.beam_time_s, twist, xy_base)
        copy_vector(pose, asked)
        find_surfels(xy_base, normals, pose, grid, settings.least_normal_cosine, found)
        used, inliers, squared_m2 = surfel_normal_equations(xy_base, normals, found, pose, settings, H, g)
        copy_matrix(H, system)
        add_prior(pose, prior.pose, prior_information, system, g)
        hold_blind_direction(pose, prior, H, settings, system, g)
        if k == settings.iterations or not solve_3x3(system, g, step):
            break
        for i in range(3):
            pose[i] -= step[i]
        if math.hypot(step[0], step[1]) < settings.settled_m and abs(step[2]) < settings.settled_rad:
            break
    pose[2] = wrap(pose[2])
    if inliers < doubt_share * used:
        cost = surfel_cost(xy_base, normals, found, asked, 1.5 * grid.cell_m, settings)
        cost += 0.5 * add_prior(asked, prior.pose, prior_information, system, g)
    return cost, used, inliers, squared_m2


@njit(cache=True, nogil=True)
def match_scan(returns, normals, prior, grid, settings, doubt_share, xy_base):
    """Pose of a scan in a sub-map.

    returns     Returns            end points at their own moments
    normals     (N, 3) float64     from estimate_normals, base frame
    prior       Prior
    grid        SurfelGrid
    settings    MatchSettings
    doubt_share float              with fewer points than that on the map, other starts are tried
    xy_base     (N, 2) float64     in: deskewed with the prior's twist; out: with the matched one
    Returns MatchResult.
    """
    H = np.empty((3, 3))
    information = np.zeros((3, 3))
    prior_information = np.zeros((3, 3))
    if invert_3x3(prior.step_covariance, information):
        rotate_information(information, prior.pose[2], prior_information)
    # The prediction may lie outside the catchment of the surfels: then let the coarse map lead there, from
    # the predicted heading and from two beside it. What costs least is kept.
    field = LikelihoodField(grid.tiles, grid.field, grid.cell_m)
    coarse = AlignSettings(settings.coarse_sigma, settings.coarse_beams, settings.coarse_iterations)
    predicted_xy = xy_base.copy()
    trial_xy = xy_base.copy()
    trial_pose = prior.pose.copy()
    trial_H = np.empty((3, 3))
    pose = np.empty(3)
    cost = squared_m2 = 0.0
    used = inliers = 0
    for start in range(4):
        if start > 0:
            if inliers >= doubt_share * used:
                break
            copy_matrix(predicted_xy, trial_xy)
            copy_vector(prior.pose, trial_pose)
            side = 0.0 if start == 1 else (1.0 if start == 2 else -1.0)
            trial_pose[2] += 2.0 * side * math.sqrt(prior.step_covariance[2, 2])
            coarse_align(trial_xy, prior.pose, prior_information, field, coarse, trial_pose)
        trial_cost, trial_used, trial_inliers, trial_squared_m2 = fine_align(
            returns,
            normals,
            prior,
            prior_information,
            grid,
            settings,
            doubt_share if start == 0 else math.inf,
            trial_xy,
            trial_pose,
            trial_H,
        )
        if start == 0 or trial_cost < cost:
            cost = trial_cost
            used = trial_used
            inliers = trial_inliers
            squared_m2 = trial_squared_m2
            copy_vector(trial_pose, pose)
            copy_matrix(trial_xy, xy_base)
            copy_matrix(trial_H, H)
    twist = np.empty(3)
    learn_twist(prior, pose, twist)
    least, direction = weakest_direction(H)
    weakest = math.sqrt(settings.covariance_scale / least) if least > 0.0 else math.inf
    # The points of a scan share errors (of the map, of the range) that do not average out: hence the scale.
    rotate_information(H, -pose[2], information)
    points_information = information.copy()
    if invert_3x3(prior.covariance, prior_information):
        for i in range(3):
            for j in range(3):
                information[i, j] = information[i, j] / settings.covariance_scale + prior_information[i, j]
    covariance = np.zeros((3, 3))
    if not invert_3x3(information, covariance):
        copy_matrix(prior.covariance, covariance)
    share = inliers / used if used > 0 else 0.0
    return MatchResult(
        pose,
        twist,
        covariance,
        share,
        used,
        weakest,
        wrap(direction - pose[2]),
        points_information,
        math.sqrt(squared_m2),
    )
