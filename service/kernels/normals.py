"""Normal of the wall at each end point, from the neighbouring beams."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D, Int32_1D
from service.kernels.compiled import inner_kernel, kernel

WALL_M = 0.004  # roughness of a plane wall
BEAMS_EACH_SIDE, MAX_BEAMS_EACH_SIDE = 4, 32  # of a window
# A gap: points farther apart than GAP_M or noise explains, plus so many beam steps. Noise must not split an
# oblique wall, because that would bias the direction of its parts.
GAP_M, GAP_STEPS, GAP_SIGMAS = 0.06, 5.0, 3.5
# Grazing beams hit a wall in steps up to this length, each longer than the one before by at most this factor.
MAX_STEP_M, MAX_GROWTH = 1.0, 1.5
IN_LINE_SIGMAS = 3.0  # gate for a point off the line of two others
THICK_SIGMAS = 2.0  # gate of the scatter across a plane
ANGLE_SIGMA_RAD = 0.1  # target sigma of a normal; the window grows until it is reached
MAX_ANGLE_SIGMAS = 2.0  # times the target sigma: a less certain normal is discarded
MIN_COS_INCIDENCE = 0.05  # beams that graze more are not used
GRAZING_WEIGHT = 5.0  # limit of a point's weight at grazing incidence; head-on it is 1
ROUGH_WEIGHT = 0.01  # of a point that lies on no plane
# Beside an edge, where the window around a point contains two walls: a window on one side of the point.
MIN_SIDE = 2  # points in it besides the point itself
MIN_REACH_M = 0.12  # shorter windows fit on the side of a door
ROUND_OBJECT_M = 0.6  # width of a run up to which it is a round object: a post, a trunk or a person
MAX_SPACING_M = 0.1  # of its points: any three sparse points, each on another wall, form a plane
MIN_COS_BESIDE_EDGE = 0.5  # of the incidence: points between two walls lie along the beams
MAX_CLEAN_SCATTER = 1.0  # largest scatter across, over the expected
MIN_RUNS, MAX_BEAM_GAP = 30, 4  # runs of three beams for the range noise; largest beam step within a run


@kernel(Float64_2D, Float64_1D, float, float, float, Float64_2D, Float64_2D)
def estimate_normals(xy_base, sensor_xy_m, angle_step_rad, range_sigma_m, grazing_weight, normals, moved):
    """Normal and weight of each point from the principal axes of its contiguous neighbours.

    xy_base          (N, 2) float64   end points in beam order, m, base frame
    sensor_xy_m      (2,)   float64   start of the beams, m, base frame
    angle_step_rad   float            between neighbouring beams, > 0
    range_sigma_m    float            noise of a range
    grazing_weight   float            limit of the weight at grazing incidence
    normals          (N, 3) float64   out: unit normal towards the sensor in base axes, and weight: 1 head-on
                                      up to grazing_weight on a plane, because range noise counts by the
                                      cosine of the incidence; ROUGH_WEIGHT off planes; 0 below
                                      MIN_COS_INCIDENCE
    moved            (N, 2) float64   out: the points, shifted along their walls to where their beams meet
                                      them; [24]
    """
    count = xy_base.shape[0]
    sums = np.zeros((count + 1, 5))  # of x, y, xx, xy, yy up to each point, relative to the sensor
    range_m = np.empty(count)
    first = np.empty(count, np.int64)  # of each point's run, without gaps
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
    # [16] 12 sigma^2 / (n L^2) is the variance of the direction of n points over the length L; solved for
    # beams^3 spacing^2, with `beams` on each side
    wanted_m2 = 1.5 * (range_sigma_m / ANGLE_SIGMA_RAD) ** 2
    reach = BEAMS_EACH_SIDE
    end = count  # of the run
    for i in range(count - 1, -1, -1):
        if i + 1 < count and first[i + 1] != first[i]:
            end = i + 1
        spacing_m = angle_step_rad * range_beside(range_m, first, i, end)
        spacing_m2 = spacing_m * spacing_m
        while reach < MAX_BEAMS_EACH_SIDE and (reach + 1) ** 3 * spacing_m2 <= wanted_m2:
            reach += 1  # continued from the neighbouring point instead of a cube root
        while reach > BEAMS_EACH_SIDE and reach**3 * spacing_m2 > wanted_m2:
            reach -= 1
        low = max(first[i], i - reach)
        high = min(end, i + reach + 1)
        nx, ny, weight, _, aside_m = plane_at(
            xy_base, sensor_xy_m, range_m[i], sums, i, low, high, square_m2, grazing_weight
        )
        is_edge = reach * spacing_m > MIN_REACH_M and (end - first[i]) * spacing_m > ROUND_OBJECT_M
        if weight == ROUGH_WEIGHT and is_edge:
            ex, ey, of_side, aside_of_side = plane_beside_edge(
                xy_base, sensor_xy_m, range_m[i], sums, i, first[i], end, reach, square_m2, grazing_weight
            )
            if of_side != ROUGH_WEIGHT:
                nx = ex
                ny = ey
                weight = of_side
                aside_m = aside_of_side
        normals[i, 0] = nx
        normals[i, 1] = ny
        normals[i, 2] = weight
        moved[i, 0] = xy_base[i, 0] - aside_m * ny
        moved[i, 1] = xy_base[i, 1] + aside_m * nx


@inner_kernel
def is_grazed(xy_base, sensor_xy_m, i, angle_step_rad, square_m2):
    """Whether the distant points i - 1 and i are on one wall at grazing incidence: in line with two
    neighbours.

    Three points are not enough: at the edge of a door a beam on both walls ends between them.
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
    """Whether point k and its neighbours, of consecutive beams and similar steps, are in line."""
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
    # The middle point is off the line of the outer two by `off` over their distance.
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
    """Whether two points (m, from the sensor) are of consecutive beams."""
    sine = abs(x * other_y - y * other_x)
    squares = (x * x + y * y) * (other_x * other_x + other_y * other_y)
    return sine * sine < (1.5 * angle_step_rad) ** 2 * squares


@inner_kernel
def plane_beside_edge(xy_base, sensor_xy_m, range_m, sums, i, first, end, reach, square_m2, grazing_weight):
    """Normal (2,), weight and shift of point i by the longest clean window on one side; see plane_at.

    first, end   the run of the point
    reach        points of the longest window besides the point
    The weight is ROUGH_WEIGHT where no window is clean. The outermost point of a window may lie beyond the
    next edge, within noise: it is left out of windows of more than MIN_SIDE.
    """
    nx = 1.0
    ny = 0.0
    weight = ROUGH_WEIGHT
    aside_m = 0.0
    for side in range(reach, MIN_SIDE - 1, -1):
        least = MAX_CLEAN_SCATTER
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
        if least < MAX_CLEAN_SCATTER:
            break
    return nx, ny, weight, aside_m


@inner_kernel
def small_eigenvector(half, off):
    """Unit eigenvector (2,) of the small eigenvalue of a symmetric 2 x 2 matrix; 0, 0 where both are equal.

    half   half of its first diagonal entry less the second
    off    entry off the diagonal
    """
    root = math.hypot(half, off)
    x, y = -off, half + root
    if half < 0.0:  # the same direction, in the form without cancellation
        x, y = half - root, off
    length = math.sqrt(x * x + y * y)
    if length == 0.0:
        return 0.0, 0.0
    return x / length, y / length


@inner_kernel
def plane_at(xy_base, sensor_xy_m, range_m, sums, i, low, high, square_m2, grazing_weight):
    """Unit normal (2,) of point i by the points low to high - 1, its weight, their scatter across over the
    expected, and the shift of point i along the wall, m; see estimate_normals.
    """
    most_rad2 = (MAX_ANGLE_SIGMAS * ANGLE_SIGMA_RAD) ** 2
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
        # [20] The point itself is left out, so that its error does not affect its normal, and the noise along
        # the beam is subtracted, because at oblique incidence it tilts the line.
        x = xy_base[i, 0] - sensor_xy_m[0] - sx / n
        y = xy_base[i, 1] - sensor_xy_m[1] - sy / n
        own = n / (n - 1.0)
        noise = (n - 4) * square_m2
        tilt = b - own * x * y - noise * nx * ny
        lean = half - 0.5 * own * (x * x - y * y) - 0.5 * noise * (nx * nx - ny * ny)
        ex, ey = small_eigenvector(lean, tilt)
        if ex != 0.0 or ey != 0.0:
            cosine = ex * nx + ey * ny
            sine = nx * ey - ny * ex  # of the beam, to the left of the normal
            if cosine < 0.0:
                ex = -ex
                ey = -ey
                cosine = -cosine
                sine = -sine
            nx = ex
            ny = ey
            # [17] the scatter across a plane has n - 2 degrees of freedom
            expected = square_m2 * cosine * cosine + WALL_M * WALL_M
            spread = THICK_SIGMAS * math.sqrt(2.0 / max(n - 2, 1))
            excess = (mean - root) / (max(n - 2, 1) * expected)
            thin = excess < 1.0 + spread
            # The expected, not the observed scatter: else an outlier would affect its own selection.
            is_direction_known = expected < most_rad2 * (mean + root)
            if thin and is_direction_known:
                weight = 0.0
                if cosine >= MIN_COS_INCIDENCE:
                    square = cosine * cosine
                    weight = 1.0 / (square + (1.0 - square) / grazing_weight)
                    # [24] part of the point's distance from the line that is noise
                    off = (nx * x + ny * y) * square_m2 * square / expected
                    aside_m = off * sine / cosine
    return nx, ny, weight, excess, aside_m


@inner_kernel
def range_beside(range_m, first, i, end):
    """Mean range of the two neighbours of point i in its run, m: independent of its own error."""
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
    """Range noise of a scan, m; 0.0 where it has too few runs of three beams; [19].

    Along walls the second difference of ranges is noise; the median of its magnitude is 0.6745 sqrt(6) sigma.
    Runs are of consecutive beams, or of every second to fourth one where there are too few: a LUX at 25 Hz
    fills every second beam of its grid.

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
