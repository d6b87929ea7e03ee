import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.kernels import icp
from service.kernels.icp import icp_point_to_point
from tests.service.kernels.inner import from_python

closest_points = from_python(icp.closest_points)


def room(count: int) -> np.ndarray:
    """Points on the walls of a room of 8 x 5 m, seen from inside."""
    angle = np.linspace(-3.0, 3.0, count)
    reach = np.minimum(4.0 / np.abs(np.cos(angle)), 2.5 / np.maximum(np.abs(np.sin(angle)), 1e-9))
    return np.stack([reach * np.cos(angle) + 0.3, reach * np.sin(angle)], axis=1)


def test_the_closest_points_are_those_of_a_tree() -> None:
    noise = np.random.default_rng(1)
    xy = noise.uniform(-4.0, 4.0, (300, 2))
    # All round, beside, across the jump of the bearing.
    for corner in ((-3.0, -3.0), (1.0, -3.0), (-7.0, -1.0)):
        others = noise.uniform(0.0, 6.0, (200, 2)) + corner
        bearing_rad = np.arctan2(others[:, 1], others[:, 0])
        order = np.argsort(bearing_rad)
        others, bearing_rad = others[order], bearing_rad[order]
        distance, at = cKDTree(others).query(xy)
        for most_m in (0.3, 100.0):
            partner = np.empty(300, np.int64)
            closest_points(xy, others, bearing_rad, most_m, partner)
            np.testing.assert_array_equal(partner, np.where(distance < most_m, at, -1))


# C3
def test_a_known_motion_is_found_and_the_rest_is_its_rms() -> None:
    older = room(400)
    motion = np.array([0.05, -0.03, 0.02])
    c, s = math.cos(motion[2]), math.sin(motion[2])
    newer = (older - motion[:2]) @ np.array([[c, -s], [s, c]])
    result = icp_point_to_point(newer, older, np.zeros(3), 1.0, 100, 1e-6)
    np.testing.assert_allclose(result.step, motion, atol=1e-3)
    assert result.rms_m < 1e-3
    assert result.paired == 400
    moved = newer @ np.array([[c, s], [-s, c]]) + motion[:2]
    np.testing.assert_allclose(moved, older, atol=1e-9)  # q = R p + t, as in eqs. (3), (4)


def test_without_pairs_the_guess_is_handed_back() -> None:
    start = np.array([1.0, 2.0, 0.5])
    for older in (np.empty((0, 2)), room(50) + 100.0):
        result = icp_point_to_point(room(50), older, start, 1.0, 20, 1e-6)
        np.testing.assert_array_equal(result.step, start)
        assert result.rms_m == math.inf


def test_the_rms_is_that_of_the_noise_between_the_scans() -> None:
    noise = np.random.default_rng(2)
    older = room(2000)
    newer = older + 0.02 * noise.standard_normal(older.shape)
    result = icp_point_to_point(newer, older, np.zeros(3), 1.0, 1, 1e-6)
    distance = cKDTree(older).query(newer)[0]
    assert result.rms_m == pytest.approx(math.sqrt((distance**2).mean()), rel=0.05)
