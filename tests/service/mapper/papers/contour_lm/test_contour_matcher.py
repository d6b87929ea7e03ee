import numpy as np
import pytest

from service.estimator.motion import Prediction
from service.geometry.se2 import SE2
from service.mapper.papers.contour_lm.contour_map import ContourMap, ContourMapConfig
from service.mapper.papers.contour_lm.contour_matcher import ContourLm, ContourLmConfig
from tests.service.mapper.maps.points import match_at, points_of

SETTINGS = {"floor_position_m": 1e-6, "floor_heading_rad": 1e-6, "estimate_velocity": False}


def test_prediction_and_scan_share_the_pose_by_the_covariances_that_are_reported() -> None:
    """A prediction as sure as the scan, 8 mm beside where the scan alone fits, draws it about half-way."""
    along_m = np.arange(-2.0, 2.0, 0.05) + 0.025
    side = np.stack((along_m, np.full(80, 2.0)), axis=1)
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    walls = np.concatenate([side @ np.linalg.matrix_power(quarter, turn) for turn in range(4)])
    random, drawn = np.random.default_rng(1), ContourMap(ContourMapConfig(levels=1, insert_distance_m=0.0))
    for _ in range(20):
        seen = points_of(walls + random.normal(0.0, 0.02, walls.shape))
        drawn.insert(seen, match_at(SE2(), seen))
    scan = points_of(walls + random.normal(0.0, 0.02, walls.shape))

    def aligned(prior: str, at: SE2, covariance: np.ndarray) -> tuple[SE2, np.ndarray]:
        matcher = ContourLm(ContourLmConfig(prior=prior, **SETTINGS))  # type: ignore[arg-type]
        still = Prediction(at, (0.0, 0.0, 0.0), covariance, covariance, np.zeros((3, 3)), 0.1, 0.0, True)
        measured = matcher.align(scan, still, drawn).measured
        return measured.pose_odom_base, measured.information

    alone, information = aligned("always", SE2(), 1e4 * np.eye(3))
    beside = SE2(alone.x_m + 0.008, alone.y_m, alone.theta_rad)
    joined, _ = aligned("always", beside, np.linalg.inv(information))
    assert (joined.x_m - alone.x_m) / 0.008 == pytest.approx(0.5, abs=0.2)


def test_smooth_walls_say_little_of_the_position_along_them() -> None:
    """The cells of a wall are rough: their slopes along it would fix the way to 4 mm, where no one knows it.

    What is left, 22 mm a scan, are normals of short pieces, tilted by the noise of the ranges.
    """
    along_m = np.arange(-8.0, 8.0, 0.05)
    walls = np.concatenate([np.stack((along_m, np.full(len(along_m), y_m)), axis=1) for y_m in (-1.0, 1.0)])
    random, drawn = np.random.default_rng(2), ContourMap(ContourMapConfig(levels=1, insert_distance_m=0.0))
    for _ in range(20):
        seen = points_of(walls + random.normal(0.0, 0.02, walls.shape))
        drawn.insert(seen, match_at(SE2(), seen))
    scan = points_of(walls + random.normal(0.0, 0.02, walls.shape))
    guessed = Prediction(
        SE2(), (0.0, 0.0, 0.0), 1e-4 * np.eye(3), 1e-4 * np.eye(3), np.zeros((3, 3)), 0.1, 0.0, False
    )
    matcher = ContourLm(ContourLmConfig(**SETTINGS))  # type: ignore[arg-type]
    measured = matcher.align(scan, guessed, drawn).measured
    along_sigma_m, across_sigma_m = np.sqrt(np.diag(measured.covariance)[:2])
    assert across_sigma_m < 0.004
    assert along_sigma_m > 0.015
