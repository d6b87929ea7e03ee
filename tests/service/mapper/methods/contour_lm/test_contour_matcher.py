import numpy as np
import pytest

from service.fusion.motion import Prediction
from service.geometry.se2 import SE2
from service.mapper.methods.contour_lm.contour_map import ContourMap, ContourMapConfig
from service.mapper.methods.contour_lm.contour_matcher import ContourLm, ContourLmConfig
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

    alone, information = aligned("never", SE2(), 1e-8 * np.eye(3))
    beside = SE2(alone.x_m + 0.008, alone.y_m, alone.theta_rad)
    joined, _ = aligned("always", beside, np.linalg.inv(information))
    assert (joined.x_m - alone.x_m) / 0.008 == pytest.approx(0.5, abs=0.2)
