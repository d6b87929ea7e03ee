"""Direction of the walls of a building, from one scan."""

import math

import numpy as np
import numpy.typing as npt

BINS = 180  # of half a degree: directions of walls repeat every quarter turn
CHORD_BEAMS = 8  # length of a chord in beams, which averages noise
NEAR_PEAK_RAD = math.radians(3.0)
QUARTER_RAD = math.pi / 2.0


def building_axes(
    xy_base: npt.NDArray[np.float64], gap_m: npt.NDArray[np.float64], least_inlier_ratio: float
) -> float | None:
    """Direction of the walls in the base frame, rad in (-pi/4, pi/4]; None without a dominant direction.

    xy_base       (N, 2) m, in beam order
    gap_m         (N,) m: a longer step to the next point ends a surface
    least_inlier_ratio   share of the length of all chords within 3 deg of the direction

    The peak is that of a histogram of chord directions modulo a quarter turn, weighted with length; the
    direction is the mean of the chords near it, weighted with squared length.
    """
    if len(xy_base) <= CHORD_BEAMS:
        return None
    step_m = np.hypot(*np.diff(xy_base, axis=0).T)
    breaks = np.concatenate([[0], np.cumsum(step_m > np.maximum(gap_m[1:], gap_m[:-1]))])
    unbroken = breaks[CHORD_BEAMS:] == breaks[:-CHORD_BEAMS]
    chord = (xy_base[CHORD_BEAMS:] - xy_base[:-CHORD_BEAMS])[unbroken]
    length_m = np.hypot(*chord.T)
    if not length_m.sum() > 0.0:
        return None
    direction = np.arctan2(chord[:, 1], chord[:, 0])
    place = np.floor(np.remainder(direction, QUARTER_RAD) / QUARTER_RAD * BINS).astype(int) % BINS
    histogram = np.bincount(place, weights=length_m, minlength=BINS)
    smooth = sum(np.roll(histogram, shift) for shift in (-2, -1, 0, 1, 2))
    peak = (float(np.argmax(smooth)) + 0.5) / BINS * QUARTER_RAD
    off = np.remainder(direction - peak + QUARTER_RAD / 2.0, QUARTER_RAD) - QUARTER_RAD / 2.0
    near = np.abs(off) < NEAR_PEAK_RAD
    if length_m[near].sum() < least_inlier_ratio * length_m.sum():
        return None
    axes = peak + float(np.average(off[near], weights=length_m[near] ** 2))
    return axes if axes <= QUARTER_RAD / 2.0 else axes - QUARTER_RAD
