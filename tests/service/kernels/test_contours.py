import math

import numpy as np
import pytest

from service.kernels.contours import ALONE, extract_contours


def contours_of(xy: np.ndarray, longest_m: float = 0.15, most_ratio: float = 2.0) -> np.ndarray:
    contour = np.full(len(xy), 99, np.int32)
    extract_contours(np.ascontiguousarray(xy, dtype=float), longest_m, most_ratio, contour)
    return contour


def row(*steps_m: float) -> np.ndarray:
    x = np.concatenate([[0.0], np.cumsum(steps_m)])
    return np.column_stack([x, np.zeros_like(x)])


def test_a_wall_is_one_contour() -> None:  # A13
    angle = np.arange(math.radians(-40.0), math.radians(40.0), math.radians(0.5))
    wall = np.column_stack([np.full_like(angle, 5.0), 5.0 * np.tan(angle)])
    assert set(contours_of(wall)) == {0}


def test_a_long_step_and_an_unlike_step_end_a_contour() -> None:  # A13 A14
    assert list(contours_of(row(0.05, 0.05, 0.3, 0.06, 0.06))) == [0, 0, 0, 1, 1, 1]
    assert list(contours_of(row(0.04, 0.04, 0.0841, 0.0841))) == [0, 0, 0, 1, 1]
    assert set(contours_of(row(0.04, 0.04, 0.079, 0.079))) == {0}


@pytest.mark.parametrize("seed", range(5))
def test_contours_keep_their_bounds_and_leave_no_seed(seed: int) -> None:  # A11 A12 A13 A15
    noise = np.random.default_rng(seed)
    xy = np.cumsum(noise.exponential(0.06, (400, 2)), axis=0)
    contour = contours_of(xy)
    step_m = np.hypot(*np.diff(xy, axis=0).T)
    joined = (contour[1:] == contour[:-1]) & (contour[1:] != ALONE)
    assert (step_m[joined] <= 0.15).all()
    for number in range(contour.max() + 1):
        at = np.flatnonzero(contour == number)
        assert len(at) >= 2
        assert (np.diff(at) == 1).all()
        steps = step_m[at[:-1]]
        ratio = np.maximum(steps[1:], steps[:-1]) / np.minimum(steps[1:], steps[:-1])
        assert (ratio <= 2.0).all()
    free = (contour[1:] == ALONE) & (contour[:-1] == ALONE)
    assert (step_m[free] > 0.15).all()
