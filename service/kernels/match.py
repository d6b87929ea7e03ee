"""Scan to sub-map matching: Gauss-Newton on surfels, coarse then fine, deskewed again between iterations.

Where it fails, a coarse likelihood map gives other initial poses.
"""

import math
from typing import NamedTuple

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.compiled import inner_kernel, kernel
from service.kernels.deskew import Returns, deskew_points
from service.kernels.likelihood import LikelihoodField
from service.kernels.likelihood_lm import LmSettings, align_points, thin_evenly
from service.kernels.linear3 import copy_matrix, copy_vector, solve_3x3
from service.kernels.pose_information import (
    invert_3x3,
    rotate_information,
    weakest_direction,
    wrap,
)
from service.kernels.scan_information import scan_information
from service.kernels.surfel_equations import surfel_cost, surfel_normal_equations
from service.kernels.surfels import SurfelCache, SurfelGrid, clear_cache, empty_cache, find_surfels_cached

NEAR = 10.0  # factor on the step that ends the alignment with full cells, before half cells refine the pose
COARSE_SIGMA, COARSE_BEAMS = 0.3, 180  # sigma of 1 - likelihood
MAX_HALVINGS = 4  # of a step that raises the cost; [12]
MIN_FINE_SHARE = 0.8  # inliers of half cells over those of full cells; below it the full cells decide; [32]
MIN_FINE_POINTS = 2.0  # points of this laser that a surfel of half cells stands for at least; [32]
MIN_PRIOR_WEIGHT = 0.5  # of [12], at chi2 = 11, 99 % of three degrees of freedom: the prediction contradicts


class Prior(NamedTuple):
    """Predicted pose of the base. Covariances in base axes of this pose, theta last."""

    pose: Float64_1D  # (3,) m, m, rad in the frame of the grid
    twist: Float64_1D  # (3,) m/s forward, m/s left, rad/s
    covariance: Float64_2D  # (3, 3) of the pose against the map
    twist_covariance: Float64_2D  # (3, 3) of twist (rows) and pose


class MatchSettings(NamedTuple):
    """Documented where they are configured."""

    range_sigma_m: float
    surfel_sigma_m: float
    wall_sigma_m: float
    repeats: float
    chance_chi2: float
    information_chance_chi2: float
    cauchy_m: float
    least_normal_cosine: float
    iterations: int
    inlier_m: float
    settled_m: float
    settled_rad: float
    degrees_of_freedom: float


class MatchResult(NamedTuple):
    pose: Float64_1D  # (3,)
    twist: Float64_1D  # (3,)
    covariance: Float64_2D  # (3, 3) of the pose against the map, in its base axes, by prior and scan
    # (3, 3) of the scan alone, in base axes, less information_chance_chi2; the covariance has all of it
    information: Float64_2D
    prior_weight: float  # of the prediction; 1: it agrees with the scan
    share: float  # inlier ratio, 0..1
    used: int  # points used
    weakest_sigma_m: float  # in the direction that the scan fixes least; inf: unobservable
    weakest_direction_rad: float  # that direction, in base axes


@inner_kernel
def learn_twist(prior, information, pose, weight, twist):
    """Twist at the matched pose, by the correlation of pose and twist in the prior.

    prior         Prior
    information   (3, 3) float64   of the predicted pose, in the axes of the grid
    pose          (3,)   float64   matched
    weight        float            of the prior; the correction of the twist is scaled by it
    twist         (3,)   float64   out
    """
    c = weight * math.cos(prior.pose[2])
    s = weight * math.sin(prior.pose[2])
    dx = pose[0] - prior.pose[0]
    dy = pose[1] - prior.pose[1]
    dtheta = wrap(pose[2] - prior.pose[2])
    x = information[0, 0] * dx + information[0, 1] * dy + information[0, 2] * dtheta
    y = information[1, 0] * dx + information[1, 1] * dy + information[1, 2] * dtheta
    forward = c * x + s * y
    left = -s * x + c * y
    turn = weight * (information[2, 0] * dx + information[2, 1] * dy + information[2, 2] * dtheta)
    for i in range(3):
        twist[i] = (
            prior.twist[i]
            + prior.twist_covariance[i, 0] * forward
            + prior.twist_covariance[i, 1] * left
            + prior.twist_covariance[i, 2] * turn
        )


@inner_kernel
def prior_chi2_at(pose, prior_pose, information):
    """Chi2 of a pose against the prediction; arguments as for prior_weight_at."""
    e = np.empty(3)
    e[0] = pose[0] - prior_pose[0]
    e[1] = pose[1] - prior_pose[1]
    e[2] = wrap(pose[2] - prior_pose[2])
    chi2 = 0.0
    for i in range(3):
        for j in range(3):
            chi2 += e[i] * information[i, j] * e[j]
    return chi2


@inner_kernel
def prior_weight_at(pose, prior_pose, information, freedom):
    """Weight of the prediction by Student's distribution: it falls with the error; [12].

    pose, prior_pose   (3,)   float64
    information        (3, 3) float64   of the prediction, in the axes of the grid
    freedom            float            degrees of freedom of that distribution
    Source: Lange, Little, Taylor, Robust statistical modeling using the t distribution, 1989.
    """
    return min(1.0, (freedom + 3.0) / (freedom + prior_chi2_at(pose, prior_pose, information)))


def student_cost(chi2, freedom):
    """Half the cost of a prediction with this chi2; [12]."""
    return 0.5 * (freedom + 3.0) * math.log1p(chi2 / freedom)


_student_cost = inner_kernel(student_cost)


class Problem(NamedTuple):
    """What a pose is fitted to, but for the surfels.

    returns             Returns            end points at their own times
    normals             (N, 3) float64     base frame
    prior               Prior
    prior_information   (3, 3) float64     in the axes of the grid
    settings            MatchSettings
    """

    returns: Returns
    normals: Float64_2D
    prior: Prior
    prior_information: Float64_2D
    settings: MatchSettings


class Target(NamedTuple):
    """Surfels of one resolution.

    grid          SurfelGrid
    least_count   float         as in find_surfels_cached
    cache         SurfelCache   in and out: results of previous searches
    """

    grid: SurfelGrid
    least_count: float
    cache: SurfelCache


class Alignment(NamedTuple):
    """Arrays of one alignment, filled in place.

    pose          (3,)   float64   in: initial; out: final
    xy_base       (N, 2) float64   in: deskewed with the prior's twist; out: with the matched one
    information   (3, 3) float64   out: of the scan alone, in the axes of the grid
    less_chance   (3, 3) float64   out: the same, less information_chance_chi2
    """

    pose: Float64_1D
    xy_base: Float64_2D
    information: Float64_2D
    less_chance: Float64_2D


class Fit(NamedTuple):
    """How an alignment ended."""

    cost: float  # half the cost of points and prior, where the match is in doubt; else 0
    used: int  # points
    inliers: int
    prior_weight: float


@inner_kernel
def copy_alignment(source, target):
    copy_vector(source.pose, target.pose)
    copy_matrix(source.xy_base, target.xy_base)
    copy_matrix(source.information, target.information)
    copy_matrix(source.less_chance, target.less_chance)


@inner_kernel
def cost_at(pose, xy_base, problem, target, found):
    """Half the cost of points and prior at a pose, [12].

    found   (N, 6) float64   out: from find_surfels, there
    """
    grid, settings = target.grid, problem.settings
    find_surfels_cached(
        xy_base,
        problem.normals,
        pose,
        grid,
        settings.least_normal_cosine,
        target.least_count,
        target.cache,
        found,
    )
    cost = surfel_cost(xy_base, problem.normals, found, pose, 1.5 * grid.cell_m, settings)
    chi2 = prior_chi2_at(pose, problem.prior.pose, problem.prior_information)
    return cost + _student_cost(chi2, settings.degrees_of_freedom)


@inner_kernel
def newton_step(pose, problem, weight, damping, g, information, step):
    """Gauss-Newton step by scan and prior, [15]. Returns False where it is not determined.

    weight        float            of the prior
    damping       (3, 3) float64   of the scan
    g             (3,)   float64   of the scan
    information   (3, 3) float64   of the scan
    step          (3,)   float64   out: to be subtracted from the pose
    """
    prior_pose, prior_information = problem.prior.pose, problem.prior_information
    total = np.empty(3)
    system = np.empty((3, 3))
    for i in range(3):
        total[i] = 0.0
        for j in range(3):
            total[i] += damping[i, j] * g[j] + weight * prior_information[i, j] * (
                pose[j] - prior_pose[j] if j < 2 else wrap(pose[2] - prior_pose[2])
            )
            system[i, j] = information[i, j] + weight * prior_information[i, j]
    return solve_3x3(system, total, step)


@inner_kernel
def align_on_surfels(problem, target, tolerance_factor, doubt_inlier_ratio, alignment):
    """Gauss-Newton on surfels with a prior, deskewed again with the twist of each step.

    problem             Problem
    target              Target
    tolerance_factor    float       factor on the convergence limits; 1 for a match in doubt
    doubt_inlier_ratio  float       below this inlier ratio, or with a contradicted prediction, no step may
                                    raise the cost
    alignment           Alignment   in and out
    Returns Fit; its cost is that before the last step.
    """
    returns, normals, prior, prior_information, settings = problem
    grid, least_count, cache = target
    pose, xy_base, information, less_chance = alignment
    g, step, twist = np.empty(3), np.empty(3), np.empty(3)
    H, shared, damping = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    count = xy_base.shape[0]
    found = np.empty((count, 6))
    evidence = np.empty((count, 7))
    evaluated = np.empty(3)
    moves = count > 0 and (returns.beam_time_s[0] != 0.0 or returns.beam_time_s[count - 1] != 0.0)
    used = inliers = halvings = 0
    weight = 1.0
    last = pose.copy()
    for k in range(settings.iterations + 1):
        if moves and k > 0:
            learn_twist(prior, prior_information, pose, weight, twist)
            deskew_points(returns.xy_raw, returns.beam_time_s, twist, xy_base)
        copy_vector(pose, evaluated)
        find_surfels_cached(
            xy_base, normals, pose, grid, settings.least_normal_cosine, least_count, cache, found
        )
        used, inliers = surfel_normal_equations(
            xy_base, normals, found, pose, settings, H, shared, g, evidence
        )
        weight_here = prior_weight_at(pose, prior.pose, prior_information, settings.degrees_of_freedom)
        is_in_doubt = inliers < doubt_inlier_ratio * used or weight_here < MIN_PRIOR_WEIGHT
        if is_in_doubt and 0 < k < settings.iterations and halvings < MAX_HALVINGS:
            before = cost_at(last, xy_base, problem, target, found)
            if cost_at(pose, xy_base, problem, target, found) > before:
                halvings += 1
                part = 0.5 if halvings < MAX_HALVINGS else 0.0
                for i in range(3):
                    pose[i] = last[i] + part * (pose[i] - last[i])
                continue
        is_last = halvings == MAX_HALVINGS
        halvings = 0
        copy_vector(pose, last)
        scan_information(H, shared, evidence, settings.chance_chi2, damping, information)
        weight = weight_here
        is_last = is_last or k == settings.iterations
        if is_last or not newton_step(pose, problem, weight, damping, g, information, step):
            break
        for i in range(3):
            pose[i] -= step[i]
        near = 1.0 if is_in_doubt else tolerance_factor
        if (
            math.hypot(step[0], step[1]) < near * settings.settled_m
            and abs(step[2]) < near * settings.settled_rad
        ):
            break
    if settings.information_chance_chi2 == settings.chance_chi2:
        copy_matrix(information, less_chance)
    else:
        scan_information(H, shared, evidence, settings.information_chance_chi2, damping, less_chance)
    cost = 0.0
    if inliers < doubt_inlier_ratio * used:
        cost = cost_at(evaluated, xy_base, problem, target, found)
    pose[2] = wrap(pose[2])
    return Fit(cost, used, inliers, weight)


@inner_kernel
def information_at(covariance, theta_rad, information):
    """Inverse of a covariance in base axes, in those of the grid; 0 where it has none."""
    rotated = np.zeros((3, 3))
    if invert_3x3(covariance, rotated):
        rotate_information(rotated, theta_rad, information)


@inner_kernel
def align_from_starts(problem, target, doubt_inlier_ratio, alignment):
    """Alignment from its pose and, at a low inlier ratio, from initial poses by the coarse map.

    The prediction may be outside the basin of convergence of the surfels. Then the coarse map gives initial
    poses, from the predicted heading and two beside it; the match of least cost is kept. Their prior is
    widened to the resolution of the coarse map: else wrong odometry with a small covariance would fix every
    start.

    Arguments as for align_on_surfels. Returns Fit.
    """
    settings, prior, grid = problem.settings, problem.prior, target.grid
    start, predicted_xy = alignment.pose.copy(), alignment.xy_base.copy()
    best = align_on_surfels(problem, target, NEAR, doubt_inlier_ratio, alignment)
    if best.inliers >= doubt_inlier_ratio * best.used:
        return best
    coarse_rad = grid.cell_m / 2.0  # a cell at 2 m
    loose = prior.covariance.copy()
    loose[0, 0] += grid.cell_m * grid.cell_m
    loose[1, 1] += grid.cell_m * grid.cell_m
    loose[2, 2] += coarse_rad * coarse_rad
    coarse_information = np.zeros((3, 3))
    information_at(loose, prior.pose[2], coarse_information)
    field = LikelihoodField(grid.tiles, grid.field, grid.cell_m)
    coarse = LmSettings(settings.iterations, 1e-3, 1e-4, 1e-3, 1e3, 0.0)
    trial = new_alignment(start, predicted_xy)
    for side in (0.0, 1.0, -1.0):
        copy_matrix(predicted_xy, trial.xy_base)
        copy_vector(start, trial.pose)
        trial.pose[2] += 2.0 * side * math.sqrt(prior.covariance[2, 2])
        thin, weights = thin_evenly(trial.xy_base, COARSE_BEAMS, COARSE_SIGMA)
        align_points(
            thin,
            weights,
            prior.pose,
            coarse_information,
            field,
            coarse,
            coarse.trials,
            coarse.first_damping,
            trial.pose,
            trial.information,
        )
        fit = align_on_surfels(problem, target, NEAR, math.inf, trial)
        if fit.cost < best.cost:
            best = fit
            copy_alignment(trial, alignment)
            if best.inliers >= doubt_inlier_ratio * best.used:
                break
    return best


@inner_kernel
def new_alignment(pose, xy_base):
    """An Alignment of its own arrays, from a pose and points."""
    return Alignment(pose.copy(), xy_base.copy(), np.empty((3, 3)), np.empty((3, 3)))


@kernel(Returns, Float64_2D, Prior, Float64_1D, SurfelGrid, SurfelGrid, MatchSettings, float, Float64_2D)
def match_scan(returns, normals, prior, start, grid, fine_grid, settings, doubt_inlier_ratio, xy_base):
    """Pose of a scan in a sub-map.

    returns     Returns            end points at their own times
    normals     (N, 3) float64     from estimate_normals, base frame
    prior       Prior
    start       (3,)   float64     initial pose: the prior's, or that of a search
    grid        SurfelGrid         full cells: they attract the scan first and give its inlier ratio
    fine_grid   SurfelGrid         half cells, or `grid` again: they refine the pose if at least
                                   MIN_FINE_SHARE of the inliers lies on their surfels of at least
                                   MIN_FINE_POINTS
    settings    MatchSettings
    doubt_inlier_ratio float       below this inlier ratio other initial poses are tried
    xy_base     (N, 2) float64     in: deskewed with the prior's twist; out: with the matched one
    Returns MatchResult.
    """
    prior_information = np.zeros((3, 3))
    information_at(prior.covariance, prior.pose[2], prior_information)
    problem = Problem(returns, normals, prior, prior_information, settings)
    cache = empty_cache(xy_base.shape[0])
    matched = Alignment(start.copy(), xy_base, np.empty((3, 3)), np.empty((3, 3)))
    fit = align_from_starts(problem, Target(grid, 0.0, cache), doubt_inlier_ratio, matched)
    weight = fit.prior_weight
    least_fine_count = 0.0
    if fine_grid.cell_m < grid.cell_m:
        least_fine_count = MIN_FINE_POINTS * (settings.surfel_sigma_m / settings.range_sigma_m) ** 2
    fine = new_alignment(matched.pose, xy_base)
    clear_cache(cache)
    fine_fit = align_on_surfels(problem, Target(fine_grid, least_fine_count, cache), 1.0, 0.0, fine)
    if fine_fit.inliers >= MIN_FINE_SHARE * fit.inliers:
        weight = fine_fit.prior_weight
        copy_alignment(fine, matched)
    return result_of(problem, matched, weight, fit)


@inner_kernel
def result_of(problem, matched, weight, fit):
    """MatchResult of an Alignment; weight is that of its prior, fit the one by full cells."""
    prior, pose = problem.prior, matched.pose
    twist = np.empty(3)
    learn_twist(prior, problem.prior_information, pose, weight, twist)
    least, direction = weakest_direction(matched.less_chance)
    covariance, joined = np.zeros((3, 3)), np.empty((3, 3))
    of_scan, of_prior, less_chance = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    rotate_information(matched.information, -pose[2], of_scan)
    rotate_information(problem.prior_information, -pose[2], of_prior)
    for i in range(3):
        for j in range(3):
            joined[i, j] = of_scan[i, j] + weight * of_prior[i, j]
    if not invert_3x3(joined, covariance):
        copy_matrix(prior.covariance, covariance)
    rotate_information(matched.less_chance, -pose[2], less_chance)
    return MatchResult(
        pose,
        twist,
        covariance,
        less_chance,
        weight,
        fit.inliers / fit.used if fit.used > 0 else 0.0,
        fit.used,
        math.sqrt(1.0 / least) if least > 0.0 else math.inf,
        wrap(direction - pose[2]),
    )
