"""Points of the same wall form a group: they are one observation of a pose."""

import math

from service.kernels.arrays import Float64_1D, Float64_2D, Int64_1D
from service.kernels.compiled import kernel
from service.kernels.normals import ROUGH_WEIGHT

ACROSS_M, ACROSS_SIGMAS = 0.06, 3.0  # largest distance of a wall's point from its line
MIN_WALL_COSINE = 0.97  # between the normal of a point and that of its wall
REACHES_M = (1.0, 4.0, math.inf)  # radii about its first point in which a wall is fitted, in turn
OBJECT_M = 0.3  # radius about its first point in which rough points are one object


@kernel(Float64_2D, Float64_2D, Float64_1D, Int64_1D)
def group_by_wall(xy, normals, sigma_m, group):
    """Assign each point to a straight line, of any length, or to an object beside walls.

    xy        (N, 2) float64   m
    normals   (N, 3) float64   from estimate_normals
    sigma_m   (N,)   float64   noise of each point
    group     (N,)   int64     out: 0 and up
    Returns the number of groups.
    """
    count = xy.shape[0]
    for i in range(count):
        group[i] = -1
    groups = 0
    for i in range(count):
        if group[i] >= 0:
            continue
        if normals[i, 2] <= ROUGH_WEIGHT:
            for j in range(i, count):
                is_rough = group[j] < 0 and normals[j, 2] <= ROUGH_WEIGHT
                if is_rough and math.hypot(xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]) < OBJECT_M:
                    group[j] = groups
            groups += 1
            continue
        x, y, nx, ny = xy[i, 0], xy[i, 1], normals[i, 0], normals[i, 1]
        for reach_m in REACHES_M:
            of, sx, sy, sxx, sxy, syy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
            is_last = reach_m == math.inf
            for j in range(i, count):
                if group[j] >= 0 or normals[j, 2] <= ROUGH_WEIGHT:
                    continue
                dx, dy = xy[j, 0] - x, xy[j, 1] - y
                if (
                    abs(nx * dx + ny * dy) >= max(ACROSS_M, ACROSS_SIGMAS * sigma_m[j])
                    or nx * normals[j, 0] + ny * normals[j, 1] < MIN_WALL_COSINE
                    or math.hypot(xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]) >= reach_m
                ):
                    continue
                if is_last:
                    group[j] = groups
                    continue
                of, sx, sy = of + 1, sx + dx, sy + dy
                sxx, sxy, syy = sxx + dx * dx, sxy + dx * dy, syy + dy * dy
            if of > 2 and not is_last:
                mx, my = sx / of, sy / of
                along = 0.5 * math.atan2(2.0 * (sxy / of - mx * my), sxx / of - mx * mx - syy / of + my * my)
                px, py = -math.sin(along), math.cos(along)
                if px * nx + py * ny < 0.0:
                    px, py = -px, -py
                if px * nx + py * ny > MIN_WALL_COSINE:
                    x, y, nx, ny = x + mx, y + my, px, py
        group[i] = groups
        groups += 1
    return groups
