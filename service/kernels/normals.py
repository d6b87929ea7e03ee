"""Direction of the wall at each end point, from the beams beside it."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D
from service.kernels.compiled import inner_kernel, kernel

WALL_M = 0.004  # how even a wall is, at best
BEAMS_EACH_SIDE, MAX_BEAMS_EACH_SIDE = 4, 32  # of a window
# Points farther apart than noise explains, GAP_M at least, and so many steps between beams: a gap. Noise that
# parted a wall seen aslant would part it where the next point is farther, and turn what is left of it.
GAP_M, GAP_STEPS, GAP_SIGMAS = 0.06, 5.0, 3.5
# Beams that graze a wall hit it in steps so long, each longer than the one before by at most so much.
MAX_STEP_M, MAX_GROWTH = 1.0, 1.5
IN_LINE_SIGMAS = 3.0  # a point that far off two others is not in line with them
THICK_SIGMAS = 2.0  # of its spread: a piece thicker than noise by more is no plane
ANGLE_SIGMA_RAD = 0.1  # a window grows until the wall's direction is known so well
MAX_ANGLE = 2.0  # times the direction's sigma that is asked for: known worse, a piece is rough
MIN_COS_INCIDENCE = 0.05  # beams that graze more see nothing that can be relied on
ROUGH_WEIGHT = 0.01  # of a point that lies on no plane
# Beside an edge, where the window around a point holds two walls: a window to one side of the point.
MIN_SIDE = 2  # points in it besides the point itself
MIN_REACH_M = 0.12  # windows that reach less far fit on the side of a door by themselves
MIN_WIDTH_M = 0.6  # of a run with edges; a narrower one is a post, a trunk or a person, and round
MAX_SPACING_M = 0.1  # of its points: of few and far ones, each on another wall, any three make a plane
MIN_COS_BESIDE_EDGE = 0.5  # of the incidence: what lies between two walls lies along the beams
CLEAN = 1.0  # spread across, at most, over what noise explains
MIN_RUNS, MAX_BEAM_GAP = 30, 4  # of three beams, that noise is seen in; steps between the beams of a run


@kernel(Float64_2D, Float64_1D, float, float, float, Float64_2D, Float64_1D)
def estimate_normals(xy_base, sensor_xy_m, angle_step_rad, range_sigma_m, grazing_weight, normals, aside_m):
    """Principal axes of each point and its contiguous neighbours.

    xy_base          (N, 2) float64   end points in beam order, m, base frame
    sensor_xy_m      (2,)   float64   where the beams start, m, base frame
    angle_step_rad   float            between neighbouring beams, > 0
    range_sigma_m    float            noise of a range
    grazing_weight   float            of a point whose beam runs along the wall, where one head-on has 1
    normals          (N, 3) float64   out: unit normal towards the sensor in base axes, and the weight of the
                                      point: 1 or more on a planar piece, ROUGH_WEIGHT elsewhere, 0
                                      where the beam grazes too much. An error of the range moves the point
                                      along its beam, so across a wall it counts by the cosine of the
                                      incidence: the weight is 1 head-on, grazing_weight at most
    aside_m          (N,)   float64   out: how far along its wall, to the left of the normal, a point has to
                                      be moved to where its beam meets the wall, for noise has moved it along
                                      the beam; 0 where it lies on no plane; [24]
    """
    count = xy_base.shape[0]
    sums = np.zeros((count + 1, 5))  # of x, y, xx, xy, yy up to each point, relative to the sensor
    range_m = np.empty(count)
    first = np.empty(count, np.int64)  # of the run of points without a gap that each belongs to
    square_m2 = range_sigma_m * range_sigma_m
    least_gap_m = max(GAP_M, GAP_SIGMAS * range_sigma_m)
    for i in range(count):
        x = xy_base[i, 0] - sensor_xy_m[0]
        y = xy_base[i, 1] - sensor_xy_m[1]
        sums[i + 1, 0] = sums[i, 0] + x
        sums[i + 1, 1] = sums[i, 1] + y
        sums[i + 1, 2] = sums[i, 2] + x * x
        sums[i + 1, 3] = sums[i, 3] + x * y
        sums[i + 1, 4] = sums[i, 4] + y * y
        range_m[i] = math.sqrt(x * x + y * y)
        first[i] = i
        if i > 0:
            gap_m = least_gap_m + GAP_STEPS * angle_step_rad * min(range_m[i - 1], range_m[i])
            dx = xy_base[i, 0] - xy_base[i - 1, 0]
            dy = xy_base[i, 1] - xy_base[i - 1, 1]
            if dx * dx + dy * dy < gap_m * gap_m or is_grazed(
                xy_base, sensor_xy_m, i, angle_step_rad, square_m2
            ):
                first[i] = first[i - 1]
    # [16] 12 sigma^2 / (n L^2) is the variance of the direction of n points over the length L: as many beams
    # are wanted each side as make beams^3 spacing^2 this much
    wanted_m2 = 1.5 * (range_sigma_m / ANGLE_SIGMA_RAD) ** 2
    reach = BEAMS_EACH_SIDE
    end = count  # of the run
    for i in range(count - 1, -1, -1):
        if i + 1 < count and first[i + 1] != first[i]:
            end = i + 1
        spacing_m = angle_step_rad * range_beside(range_m, first, i, end)
        spacing_m2 = spacing_m * spacing_m
        while reach < MAX_BEAMS_EACH_SIDE and (reach + 1) ** 3 * spacing_m2 <= wanted_m2:
            reach += 1  # from that of the point beside: no cube root
        while reach > BEAMS_EACH_SIDE and reach**3 * spacing_m2 > wanted_m2:
            reach -= 1
        low = max(first[i], i - reach)
        high = min(end, i + reach + 1)
        nx, ny, weight, _, aside_m[i] = plane_at(
            xy_base, sensor_xy_m, range_m[i], sums, i, low, high, square_m2, grazing_weight
        )
        is_edge = reach * spacing_m > MIN_REACH_M and (end - first[i]) * spacing_m > MIN_WIDTH_M
        if weight == ROUGH_WEIGHT and is_edge:
            ex, ey, of_side, aside = plane_beside_edge(
                xy_base, sensor_xy_m, range_m[i], sums, i, first[i], end, reach, square_m2, grazing_weight
            )
            if of_side != ROUGH_WEIGHT:
                nx = ex
                ny = ey
                weight = of_side
                aside_m[i] = aside
        normals[i, 0] = nx
        normals[i, 1] = ny
        normals[i, 2] = weight


@kernel(Float64_2D, Float64_2D, Float64_1D, Float64_2D)
def move_along_walls(xy_base, normals, aside_m, moved):
    """Points where their beams meet their walls; [24].

    xy_base   (N, 2) float64   m, base frame
    normals   (N, 3) float64   from estimate_normals, as aside_m (N,) is
    moved     (N, 2) float64   out: m, base frame
    """
    for i in range(xy_base.shape[0]):
        moved[i, 0] = xy_base[i, 0] - aside_m[i] * normals[i, 1]
        moved[i, 1] = xy_base[i, 1] + aside_m[i] * normals[i, 0]


@inner_kernel
def is_grazed(xy_base, sensor_xy_m, i, angle_step_rad, square_m2):
    """Whether points i - 1 and i, though far apart, lie on one wall that the beams graze: with two points
    beside them they are in line.

    Three are not enough: at the edge of a door the beam that lies on both walls ends somewhere between them.
    """
    if is_in_line(xy_base, sensor_xy_m, i - 1, angle_step_rad, square_m2):
        return is_in_line(xy_base, sensor_xy_m, i - 2, angle_step_rad, square_m2) or is_in_line(
            xy_base, sensor_xy_m, i, angle_step_rad, square_m2
        )
    return is_in_line(xy_base, sensor_xy_m, i, angle_step_rad, square_m2) and is_in_line(
        xy_base, sensor_xy_m, i + 1, angle_step_rad, square_m2
    )


@inner_kernel
def is_in_line(xy_base, sensor_xy_m, k, angle_step_rad, square_m2):
    """Whether point k and the two beside it are in line within noise: beams side by side, steps alike."""
    if k < 1 or k + 1 >= xy_base.shape[0]:
        return False
    x = xy_base[k, 0] - sensor_xy_m[0]
    y = xy_base[k, 1] - sensor_xy_m[1]
    ax = xy_base[k - 1, 0] - xy_base[k, 0]
    ay = xy_base[k - 1, 1] - xy_base[k, 1]
    bx = xy_base[k + 1, 0] - xy_base[k, 0]
    by = xy_base[k + 1, 1] - xy_base[k, 1]
    before = ax * ax + ay * ay
    after = bx * bx + by * by
    if max(before, after) > min(MAX_STEP_M * MAX_STEP_M, MAX_GROWTH * MAX_GROWTH * min(before, after)):
        return False
    if not is_beside(x, y, x + ax, y + ay, angle_step_rad) or not is_beside(
        x, y, x + bx, y + by, angle_step_rad
    ):
        return False
    # Of the three, the one between is off their line by `off` over the length between the outer two.
    dx = bx - ax
    dy = by - ay
    square = dx * dx + dy * dy
    off = ax * by - ay * bx
    across = x * dy - y * dx
    share = math.sqrt(before / square)
    variance = square_m2 * across * across / (x * x + y * y)  # of the noise across the line, times `square`
    variance = variance * (1.0 + share * share + (1.0 - share) * (1.0 - share)) + WALL_M * WALL_M * square
    return off * off < IN_LINE_SIGMAS * IN_LINE_SIGMAS * variance


@inner_kernel
def is_beside(x, y, other_x, other_y, angle_step_rad):
    """Whether two points (m, from the sensor) are of beams side by side: no beam between them was lost."""
    sine = abs(x * other_y - y * other_x)
    squares = (x * x + y * y) * (other_x * other_x + other_y * other_y)
    return sine * sine < (1.5 * angle_step_rad) ** 2 * squares


@inner_kernel
def plane_beside_edge(xy_base, sensor_xy_m, range_m, sums, i, first, end, reach, square_m2, grazing_weight):
    """Normal (2,), weight and way aside of point i by the longest clean window to one side, as plane_at gives
    them; ROUGH_WEIGHT: none is.

    first, end   the run of the point
    reach        points of the longest window besides the point
    The outermost point of a window may lie beyond the next edge, within noise: it is left out of a window
    of more than MIN_SIDE.
    """
    nx = 1.0
    ny = 0.0
    weight = ROUGH_WEIGHT
    aside_m = 0.0
    for side in range(reach, MIN_SIDE - 1, -1):
        least = CLEAN
        for k in range(2):
            low = i - k * side
            high = low + side + 1
            if low < first or high > end:
                continue
            x = xy_base[low, 0] - xy_base[high - 1, 0]
            y = xy_base[low, 1] - xy_base[high - 1, 1]
            if x * x + y * y > MAX_SPACING_M * MAX_SPACING_M * side * side:
                continue
            ex, ey, of_window, excess, aside = plane_at(
                xy_base, sensor_xy_m, range_m, sums, i, low, high, square_m2, grazing_weight
            )
            ahead_m = ex * (sensor_xy_m[0] - xy_base[i, 0]) + ey * (sensor_xy_m[1] - xy_base[i, 1])
            is_facing = ahead_m > MIN_COS_BESIDE_EDGE * range_m
            if of_window == ROUGH_WEIGHT or not is_facing or excess >= least:
                continue
            if side > MIN_SIDE:
                low += k
                high -= 1 - k
                ex, ey, of_window, _, aside = plane_at(
                    xy_base, sensor_xy_m, range_m, sums, i, low, high, square_m2, grazing_weight
                )
            if of_window != ROUGH_WEIGHT:
                least = excess
                nx = ex
                ny = ey
                weight = of_window
                aside_m = aside
        if least < CLEAN:
            break
    return nx, ny, weight, aside_m


@inner_kernel
def plane_at(xy_base, sensor_xy_m, range_m, sums, i, low, high, square_m2, grazing_weight):
    """Unit normal (2,) of point i by the points low to high - 1, its weight, their spread across in units of
    what noise explains, and how far point i is to be moved along the wall, m; see estimate_normals.
    """
    most_rad2 = (MAX_ANGLE * ANGLE_SIGMA_RAD) ** 2
    n = high - low
    nx = 1.0
    ny = 0.0
    if range_m > 0.0:
        nx = (sensor_xy_m[0] - xy_base[i, 0]) / range_m
        ny = (sensor_xy_m[1] - xy_base[i, 1]) / range_m
    weight = ROUGH_WEIGHT
    excess = 0.0
    aside_m = 0.0
    if n >= 3:
        sx = sums[high, 0] - sums[low, 0]
        sy = sums[high, 1] - sums[low, 1]
        a = sums[high, 2] - sums[low, 2] - sx * sx / n
        b = sums[high, 3] - sums[low, 3] - sx * sy / n
        c = sums[high, 4] - sums[low, 4] - sy * sy / n
        half = 0.5 * (a - c)
        root = math.sqrt(half * half + b * b)
        mean = 0.5 * (a + c)
        # [20] The point itself tells nothing of the direction, for its error shall not be in it; and
        # noise along the beam tilts the line of points that are seen aslant: both are taken out.
        x = xy_base[i, 0] - sensor_xy_m[0] - sx / n
        y = xy_base[i, 1] - sensor_xy_m[1] - sy / n
        own = n / (n - 1.0)
        noise = (n - 4) * square_m2
        tilt = b - own * x * y - noise * nx * ny
        lean = half - 0.5 * own * (x * x - y * y) - 0.5 * noise * (nx * nx - ny * ny)
        if lean >= 0.0:  # eigenvector of the small eigenvalue, from the form that cancels nothing
            ex = -tilt
            ey = lean + math.hypot(lean, tilt)
        else:
            ex = lean - math.hypot(lean, tilt)
            ey = tilt
        length = math.sqrt(ex * ex + ey * ey)
        if length > 0.0:
            ex /= length
            ey /= length
            cosine = ex * nx + ey * ny
            sine = nx * ey - ny * ex  # of the beam, to the left of the normal
            if cosine < 0.0:
                ex = -ex
                ey = -ey
                cosine = -cosine
                sine = -sine
            nx = ex
            ny = ey
            # [17] the spread across a plane has n - 2 degrees of freedom
            expected = square_m2 * cosine * cosine + WALL_M * WALL_M
            spread = THICK_SIGMAS * math.sqrt(2.0 / max(n - 2, 1))
            excess = (mean - root) / (max(n - 2, 1) * expected)
            thin = excess < 1.0 + spread
            # Not the scatter measured: a point that is off would judge itself by it.
            is_direction_known = expected < most_rad2 * (mean + root)
            if thin and is_direction_known:
                weight = 0.0
                if cosine >= MIN_COS_INCIDENCE:
                    square = cosine * cosine
                    weight = 1.0 / (square + (1.0 - square) / grazing_weight)
                    # [24] what noise explains of how far the point is off the line
                    off = (nx * x + ny * y) * square_m2 * square / expected
                    aside_m = off * sine / cosine
    return nx, ny, weight, excess, aside_m


@inner_kernel
def range_beside(range_m, first, i, end):
    """Mean range of the two points beside point i of a run, m: free of the error of its own."""
    total = 0.0
    count = 0
    if i > first[i]:
        total += range_m[i - 1]
        count += 1
    if i + 1 < end:
        total += range_m[i + 1]
        count += 1
    return total / count if count > 0 else range_m[i]


@kernel(Float64_2D, Int32_1D, Float64_1D)
def range_noise(xy_raw, beam, sensor_xy_m):
    """Noise of a range as a scan shows it, m; 0.0 where it shows none: fewer than 30 runs of three beams.

    Runs are of beams side by side; where there are too few, of every second one, up to every fourth: a LUX
    at 25 Hz fills every second beam of its grid.

    Along walls the range of a beam is nearly the mean of its neighbours', so second differences are noise:
    their median is 0.6745 sqrt(6) sigma of normal noise, whatever edges and people are in view; [19].

    xy_raw        (N, 2) float64   m, in beam order
    beam          (N,)   int32     number of each point's beam
    sensor_xy_m   (2,)   float64
    Source: Gasser, Sroka, Jennen-Steinmetz, Residual variance and residual pattern, 1986.
    """
    bins = 1000
    width_m = 5e-4
    range_m = np.empty(xy_raw.shape[0])
    for i in range(xy_raw.shape[0]):
        range_m[i] = math.hypot(xy_raw[i, 0] - sensor_xy_m[0], xy_raw[i, 1] - sensor_xy_m[1])
    histogram = np.zeros(bins, np.int64)
    total = 0
    for gap in range(1, MAX_BEAM_GAP + 1):
        histogram[:] = 0
        total = 0
        for i in range(1, xy_raw.shape[0] - 1):
            if beam[i + 1] - beam[i] != gap or beam[i] - beam[i - 1] != gap:
                continue
            k = int(abs(range_m[i - 1] - 2.0 * range_m[i] + range_m[i + 1]) / width_m)
            if k < bins:
                histogram[k] += 1
                total += 1
        if total >= MIN_RUNS:
            break
    if total < MIN_RUNS:
        return 0.0
    below = 0
    for k in range(bins):
        if 2 * (below + histogram[k]) >= total:
            share = (0.5 * total - below) / histogram[k]
            return (k + share) * width_m / (0.6745 * math.sqrt(6.0))
        below += histogram[k]
    return 0.0
