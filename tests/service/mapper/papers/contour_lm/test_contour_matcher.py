import numpy as np

from service.geometry.se2 import SE2
from service.mapper.papers.contour_lm.contour_map import ContourMap, ContourMapConfig
from service.mapper.papers.contour_lm.contour_matcher import ContourLm, ContourLmConfig
from tests.service.mapper.maps.points import match_at, points_of, prediction

SETTINGS = {"floor_position_m": 1e-6, "floor_heading_rad": 1e-6, "estimate_velocity": False}


def test_smooth_walls_say_little_of_the_position_along_them() -> None:
    """The cells of a wall are rough: their slopes would constrain the unobservable position along it to 4 mm.

    What is left, 22 mm a scan, are normals of short surfaces, tilted by the noise of the ranges.
    """
    along_m = np.arange(-8.0, 8.0, 0.05)
    walls = np.concatenate([np.stack((along_m, np.full(len(along_m), y_m)), axis=1) for y_m in (-1.0, 1.0)])
    random, contours = np.random.default_rng(2), ContourMap(ContourMapConfig(levels=1, insert_distance_m=0.0))
    for _ in range(20):
        seen = points_of(walls + random.normal(0.0, 0.02, walls.shape))
        contours.insert(seen, match_at(SE2(), seen))
    scan = points_of(walls + random.normal(0.0, 0.02, walls.shape))
    guessed = prediction(SE2(), 1e-4 * np.eye(3), is_measured=False)
    matcher = ContourLm(ContourLmConfig(**SETTINGS))  # type: ignore[arg-type]
    measured = matcher.align(scan, guessed, contours).measured
    along_sigma_m, across_sigma_m = np.sqrt(np.diag(measured.covariance)[:2])
    assert across_sigma_m < 0.004
    assert along_sigma_m > 0.015
