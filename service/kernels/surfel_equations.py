"""Normal equations of a scan's pose by the surfels beside its points: cost, gradient, Hessian.

`settings` is MatchSettings of service/kernels/match.py.
"""

import math

from service.kernels.compiled import inner_kernel
from service.kernels.linear3 import fill_symmetric


@inner_kernel
def point_information(weight, count, beside, settings):
    """Information of a point about its distance to a surfel, 1/m^2; [13].

    weight   of the point: 1 where its beam meets the wall head-on
    count    points of the noise surfel_sigma_m that the surfel stands for
    beside   points of this scan in the same cell, which share the error of its surfel
    """
    square = settings.range_sigma_m * settings.range_sigma_m
    counted = settings.surfel_sigma_m * settings.surfel_sigma_m
    wall = settings.wall_sigma_m * settings.wall_sigma_m
    return 1.0 / (square / weight + beside * (settings.repeats * counted / count + wall))


@inner_kernel
def surfel_cost(xy_base, normals, found, pose, unmatched_m, settings):
    """Half the cost of the gradient of surfel_normal_equations; separate, because its logarithms are slow.

    unmatched_m   float             a point without a surfel costs as much as one at this distance
    The others    as there.
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    squared_cauchy = settings.cauchy_m * settings.cauchy_m
    unmatched = 0.5 * squared_cauchy * math.log1p(unmatched_m * unmatched_m / squared_cauchy)
    # A missing surfel counts as one point of this scan.
    unknown_count = (settings.surfel_sigma_m / settings.range_sigma_m) ** 2
    cost = 0.0
    for i in range(xy_base.shape[0]):
        weight = normals[i, 2]
        if weight == 0.0:
            continue
        if found[i, 4] == 0.0:
            cost += point_information(weight, unknown_count, found[i, 5], settings) * unmatched
            continue
        rx = c * xy_base[i, 0] - s * xy_base[i, 1]
        ry = s * xy_base[i, 0] + c * xy_base[i, 1]
        e = found[i, 2] * (pose[0] + rx - found[i, 0]) + found[i, 3] * (pose[1] + ry - found[i, 1])
        weight = point_information(weight, found[i, 4], found[i, 5], settings)
        cost += 0.5 * weight * squared_cauchy * math.log1p(e * e / squared_cauchy)
    return cost


@inner_kernel
def surfel_normal_equations(xy_base, normals, found, pose, settings, H, shared, g, evidence):
    """Gauss-Newton system of the distances, along the surfels' normals, between points and their surfels.

    xy_base       (N, 2) float64    m, base frame
    normals       (N, 3) float64    from estimate_normals
    found         (N, 6) float64    from find_surfels
    pose          (3,)   float64    base in the frame of the surfels
    settings      MatchSettings
    H, g          (3, 3), (3,) float64   out: Hessian, and gradient of half the cost, over x, y, theta
    shared        (3, 3) float64    out: Hessian by the product of the surfel's and the scan's normal, whose
                                    noise is independent; [14]
    evidence      (N, 7) float64    out: weight of each point, 0 without a surfel; its row of the Jacobian by
                                    the surfel's normal; difference to that by the scan's normal
    Returns (points used, points within settings.inlier_m).
    Source: point-to-line ICP, Censi 2008; Cauchy weight 1 / (1 + e^2 / c^2).
    """
    c = math.cos(pose[2])
    s = math.sin(pose[2])
    squared_cauchy = settings.cauchy_m * settings.cauchy_m
    used = 0
    inliers = 0
    gx = gy = gt = 0.0
    hxx = hxy = hyy = hxt = hyt = htt = 0.0
    sxx = sxy = syy = sxt = syt = stt = 0.0
    for i in range(xy_base.shape[0]):
        weight = normals[i, 2]
        evidence[i, 0] = 0.0
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
        weight = point_information(weight, found[i, 4], found[i, 5], settings)
        weight /= 1.0 + e * e / squared_cauchy
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
        ox = c * normals[i, 0] - s * normals[i, 1]
        oy = s * normals[i, 0] + c * normals[i, 1]
        ot = oy * rx - ox * ry
        sxx += weight * nx * ox
        sxy += 0.5 * weight * (nx * oy + ny * ox)
        syy += weight * ny * oy
        sxt += 0.5 * weight * (nx * ot + ox * jt)
        syt += 0.5 * weight * (ny * ot + oy * jt)
        stt += weight * jt * ot
        evidence[i, 0] = weight
        evidence[i, 1] = nx
        evidence[i, 2] = ny
        evidence[i, 3] = jt
        evidence[i, 4] = ox - nx
        evidence[i, 5] = oy - ny
        evidence[i, 6] = ot - jt
    g[0] = gx
    g[1] = gy
    g[2] = gt
    fill_symmetric(H, hxx, hxy, hyy, hxt, hyt, htt)
    fill_symmetric(shared, sxx, sxy, syy, sxt, syt, stt)
    return used, inliers
