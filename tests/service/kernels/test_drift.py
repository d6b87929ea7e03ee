"""Against numpy on random matrices."""

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.kernels.drift import (
    LEAST_INFORMATION,
    advance_drift,
    carry_covariance,
    join_information,
    match_information,
)

LEAST = LEAST_INFORMATION * np.eye(3)
STEP = np.array([0.4, -0.1, 0.3])


def spd(seed: int, size: float = 1.0) -> np.ndarray:
    half = np.random.default_rng(seed).standard_normal((3, 3))
    return size * (half @ half.T + 0.1 * np.eye(3))


def moved(pose: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Where the base ends, seen from where it should, when it began `error` off and went STEP."""
    end = SE2(*error.tolist()) @ SE2(*STEP.tolist())
    away = SE2(*STEP.tolist()).inverse() @ end
    return np.array([away.x_m, away.y_m, away.theta_rad])


def jacobian() -> np.ndarray:
    h = 1e-6
    columns = [(moved(STEP, h * unit) - moved(STEP, -h * unit)) / (2.0 * h) for unit in np.eye(3)]
    return np.array(columns).T


def test_a_covariance_is_carried_as_the_pose_moves() -> None:
    covariance, carried, carry = spd(1), np.empty((3, 3)), jacobian()
    carry_covariance(covariance, STEP, carried)
    np.testing.assert_allclose(carried, carry @ covariance @ carry.T, rtol=1e-6, atol=1e-8)


def test_information_of_two_sources_adds() -> None:
    out = np.empty((3, 3))
    join_information(spd(1), spd(2), out)
    np.testing.assert_allclose(out, np.linalg.inv(spd(1) + spd(2) + LEAST), rtol=1e-9)


def test_where_nobody_knows_the_covariance_stays_finite() -> None:
    out, silent = np.empty((3, 3)), np.diag([0.0, 1e6, 1e6])
    join_information(silent, np.zeros((3, 3)), out)
    assert out[0, 0] == pytest.approx(1.0 / LEAST_INFORMATION)


@pytest.mark.parametrize("share", [0.3, 0.0])
def test_a_step_adds_its_piece_to_the_drift(share: float) -> None:
    covariance, along, walk = spd(3), np.array([0.2, 0.5, -0.4]), np.array([0.01, 0.02, 0.03])
    expected, carry = spd(3), jacobian()
    expected, expected_along = carry @ expected @ carry.T, carry @ along
    advance_drift(covariance, along, STEP, walk, spd(4, 100.0), share)
    if share > 0.0:
        added = np.linalg.inv(spd(4, 100.0) / share + np.diag(1.0 / walk) + LEAST)
        expected = expected + added
        expected_along = expected_along + added @ np.diag(1.0 / walk) @ [STEP[0], STEP[1], 0.0]
    np.testing.assert_allclose(covariance, expected, rtol=1e-6)
    np.testing.assert_allclose(along, expected_along, rtol=1e-6)


def test_errors_that_all_points_share_do_not_average_out() -> None:
    out, floor = np.empty((3, 3)), np.array([4e-6, 4e-6, 1e-7])
    match_information(spd(5, 1e3), 2.0, floor, out)
    expected = np.linalg.inv(2.0 * spd(5, 1e3) + LEAST) + np.diag(floor)
    np.testing.assert_allclose(out, np.linalg.inv(expected), rtol=1e-6)
    match_information(spd(5, 1e12), 2.0, floor, out)
    np.testing.assert_allclose(np.diag(out), 1.0 / floor, rtol=1e-3)
