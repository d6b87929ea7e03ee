from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.kernels.normals import ROUGH_WEIGHT
from service.mapper.components import Points
from service.mapper.scan_match.narrow_walls import NarrowWalls, narrow_wall_pool
from service.mapper.scan_match.submaps import SubmapsConfig, SurfelSubmaps
from service.mapper.scan_match.surfel_gauss_newton import SurfelGaussNewton, SurfelMatcherConfig
from simulators.worlds import build_world
from tests.service.mapper.maps.points import points_of
from tests.service.mapper.scan_match.standing_scans import hardly_known, insert_at, points_from
from tests.simulated import LMS100_50HZ

STRETCH_M = (4.3, 5.5)  # of the ring: what faces along it is 5 to 7 m ahead there, two to five beams wide


def along_the_ring() -> tuple[float, float]:
    """Mean information along the corridor, 1/m^2, and median error along it, m, of scans of the stretch."""
    world, noise = build_world("ring"), np.random.default_rng(11)
    local_map, matcher = SurfelSubmaps(SubmapsConfig()), SurfelGaussNewton(SurfelMatcherConfig())
    errors_m, information = [], []
    for x_m in np.arange(0.0, STRETCH_M[1], 0.025):
        pose = SE2(float(x_m), 0.0, 0.0)
        points = points_from(world, LMS100_50HZ, pose, noise)
        if x_m > STRETCH_M[0]:
            start = pose @ SE2(0.03 * float(noise.standard_normal()), 0.0, 0.0)
            predicted = replace(hardly_known(start), is_measured=True, travel_m=0.025)
            measured = matcher.match(points, predicted, local_map).measured
            assert measured is not None
            errors_m.append((pose.inverse() @ measured.pose_odom_base).x_m)
            information.append(measured.information[0, 0])
        insert_at(local_map, points, pose)
    return float(np.mean(information)), float(np.median(np.abs(errors_m)))


def test_doors_far_ahead_fix_the_position_along_a_corridor(monkeypatch: pytest.MonkeyPatch) -> None:
    together, error_m = along_the_ring()
    monkeypatch.setattr(NarrowWalls, "direct", lambda *_: None)
    monkeypatch.setattr(NarrowWalls, "insert", lambda self, points, normals, pose: normals)
    by_single_scans, error_by_single_scans_m = along_the_ring()
    assert together > 1.5 * by_single_scans
    assert error_m < error_by_single_scans_m


def rough_face(noise: np.random.Generator, name: str) -> Points:
    """Three points on a wall across the path, 6 m ahead or, of the laser `rear`, behind."""
    xy = np.column_stack((6.04 + 0.01 * noise.uniform(-1.0, 1.0, 3), noise.uniform(1.0, 1.25, 3)))
    xy *= -1.0 if name == "rear" else 1.0
    points = points_of(xy)
    return points._replace(scan=replace(points.scan, sensor=name))


def rough(points: Points) -> np.ndarray:
    return np.tile((-1.0, 0.0, ROUGH_WEIGHT), (len(points.xy_base), 1))


def directed(walls: NarrowWalls, points: Points) -> np.ndarray:
    normals = rough(points)
    walls.direct(points, np.zeros(3), normals)
    return normals


@pytest.mark.parametrize("lasers", [("front",), ("front", "rear")])
def test_each_laser_goes_into_both_halves(lasers: tuple[str, ...]) -> None:
    """Else two lasers by turns would have a half each, and a scan of one would meet no wall of its own."""
    noise, walls = np.random.default_rng(1), NarrowWalls(narrow_wall_pool(64), 0.1)
    for k in range(30 * len(lasers)):
        points = rough_face(noise, lasers[k % len(lasers)])
        walls.insert(points, rough(points), np.zeros(3))
    for name in lasers:
        points = rough_face(noise, name)
        assert np.all(directed(walls, points)[:, 2] >= 1.0)
        assert np.all(walls.insert(points, rough(points), np.zeros(3))[:, 2] >= 1.0)


def test_map_and_match_take_directions_from_different_key_frames() -> None:
    """Else the noise of one direction would be in both, and pass for information."""
    noise, walls = np.random.default_rng(3), NarrowWalls(narrow_wall_pool(64), 0.1)
    xy = np.column_stack((6.04 + 0.01 * noise.uniform(-1.0, 1.0, 30), noise.uniform(1.05, 1.2, 30)))
    points = points_of(xy)
    walls.insert(points, rough(points), np.zeros(3))
    assert np.all(directed(walls, points)[:, 2] == ROUGH_WEIGHT)
    for_the_map = walls.insert(points, rough(points), np.zeros(3))
    assert np.all(for_the_map[:, 2] >= 1.0)
    assert np.all(directed(walls, points)[:, 2] >= 1.0)
