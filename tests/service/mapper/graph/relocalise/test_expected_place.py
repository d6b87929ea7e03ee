"""Prior of a vehicle's place after an unmeasured motion."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from service.geometry import poses as se2
from service.mapper.graph.model.point_clouds import Fit
from service.mapper.graph.relocalise.expected_place import (
    ODOMETRY_PROBABILITY_UNMEASURED,
    SEARCH_COVARIANCE,
    OdometryPrior,
)

AT = np.array([3.0, -2.0, 2.5])
COVARIANCE = np.array([[0.04, 0.01, 0.0], [0.01, 0.02, 0.003], [0.0, 0.003, 0.004]]) * 0.1
REGION = 2.0 * math.pi * 300.0


def test_the_prior_at_dead_reckoning_grows_with_its_precision() -> None:
    """A normal distribution in base axes, by scipy, mixed with one that is level over all of the map."""
    prior = OdometryPrior(AT, COVARIANCE, REGION)
    for away in (np.zeros(3), np.array([0.1, -0.05, 0.03]), np.array([0.0, 5.0, 0.0])):
        normal = multivariate_normal(np.zeros(3), COVARIANCE + SEARCH_COVARIANCE).pdf(away)
        expected = math.log(
            (ODOMETRY_PROBABILITY_UNMEASURED * normal + (1.0 - ODOMETRY_PROBABILITY_UNMEASURED) / REGION)
            * REGION
        )
        assert prior.nats(se2.compose(AT, away)) == pytest.approx(expected, abs=1e-9)


def test_dead_reckoning_explains_a_place_within_its_gate_and_none_if_vague() -> None:
    prior = OdometryPrior(AT, COVARIANCE, REGION)
    assert prior.explains(se2.compose(AT, np.array([0.1, 0.1, 0.05])))
    assert not prior.explains(se2.compose(AT, np.array([0.0, 1.0, 0.0])))
    assert not OdometryPrior(AT, 100.0 * np.eye(3), REGION).explains(AT)


def test_a_fit_fused_with_dead_reckoning_is_the_least_squares_of_both() -> None:
    """Along a corridor dead reckoning fixes the position, across it the walls do."""
    prior = OdometryPrior(AT, COVARIANCE, REGION)
    fit_at = AT + np.array([0.2, 0.02, 0.01])
    information = np.diag([1e-6, 1e6, 1e6])  # axes of the map
    fused = prior.joined(Fit(fit_at, information, 0.4))
    c, s = math.cos(AT[2]), math.sin(AT[2])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    root = np.linalg.cholesky(np.linalg.inv(turn @ (COVARIANCE + SEARCH_COVARIANCE) @ turn.T)).T
    rows = np.vstack((np.sqrt(information), root))
    values = np.concatenate((np.sqrt(information) @ fit_at, root @ AT))
    np.testing.assert_allclose(fused.pose, np.linalg.lstsq(rows, values, rcond=None)[0], atol=1e-9)
    np.testing.assert_allclose(fused.information, rows.T @ rows)
    assert abs(fused.pose[1] - fit_at[1]) < 1e-3 < 0.1 < abs(fused.pose[0] - fit_at[0])
