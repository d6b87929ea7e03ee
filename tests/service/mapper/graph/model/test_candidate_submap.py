"""A sub-map is found at its true pose, also where the two passes saw different ground."""

import math

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.graph.model.candidate_submap import (
    LIKELIHOOD_STEP,
    LOOP_UNKNOWN_LIKELIHOOD,
    MIN_LOOP_SCORE,
    CandidateSubmap,
    cloud_of,
)
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops import loop_of
from service.mapper.graph.model.point_clouds import CELL_M, PointCloud, SurfelSet, cloud_with_noise, joined
from tests.service.mapper.graph.key_frames import append

STEP_M = 0.3
OFF_M, WINDOW_M = 0.2, 1.0  # by how much odometry is wrong, and what is searched


def out_and_back() -> KeyframeList:
    """Along a bare corridor from x = 8 to 34 m and back, in key frames whose poses in odom are true."""
    noise, keyframes, there = np.random.default_rng(7), KeyframeList(), np.arange(8.0, 34.0, STEP_M)
    for x_m, theta_rad in [*((x, 0.0) for x in there), *((x, math.pi) for x in there[::-1])]:
        walls = [(x_m - 20.0, side, x_m + 20.0, side) for side in (-1.0, 1.0)]
        append(keyframes, walls, SE2(x_m, 0.0, theta_rad), 0, noise, sigma_m=0.04)
    return keyframes


def places_of(keyframes: KeyframeList, last: int) -> tuple[CandidateSubmap, PointCloud, Floats]:
    """The outward path, the last 5 m of the return path up to a key frame, and the pose of these."""
    reach = round(5.0 / STEP_M)
    reference = last - reach // 2
    outward = np.arange(keyframes.count // 2)
    near = int(outward[np.argmin(abs(keyframes.odom[outward, 0] - keyframes.odom[reference, 0]))])
    submap = CandidateSubmap(keyframes, range(near - reach, near + reach + 1), near)
    cloud = cloud_of(keyframes, range(last - reach, last + 1), reference)
    return submap, cloud, se2.between(keyframes.odom[near], keyframes.odom[reference])


def test_along_a_bare_corridor_the_expected_pose_applies():
    """Wherever a search has put it: the walls fix it across, nothing along, and the covariance shows that."""
    keyframes = out_and_back()
    for last in range(106, 130, 4):  # of the return path, from 28 m on
        submap, cloud, true = places_of(keyframes, last)
        expected = true + np.array([OFF_M, 0.01, 0.002])
        chosen = true + np.array([-0.9, 0.0, 0.0])
        fit = submap.align_about(cloud, chosen, expected, WINDOW_M, 0.06)
        assert abs(fit.pose[0] - expected[0]) < 0.03
        assert abs(fit.pose[1] - true[1]) < 0.006
        loop = loop_of(submap.reference, last, fit.pose, fit.information, fit.share)
        assert loop.covariance[0, 0] > 1.0, "the walls say how far along"


def test_key_frames_of_one_wall_share_the_errors_of_its_surfels():
    side = np.linspace(-1.98, 1.98, 100)
    wall = np.column_stack((np.full(100, 2.05), side))
    once = cloud_with_noise(wall, np.tile([-1.0, 0.0, 1.0], (100, 1)))
    surfels, origin = SurfelSet(once), np.zeros(3)

    def information_along(cloud: PointCloud) -> float:
        return float(surfels.align(cloud, origin).information[0, 0])

    often = joined([once] * 16)
    assert information_along(often) > 8.0 * information_along(once)
    shared = surfels.align_with_shared_errors(often, origin, 0.0)
    assert shared.information[0, 0] < 3.0 * information_along(once)


def test_a_search_finds_the_cell_and_refuses_what_no_wall_supports():
    """The field is kept as bytes: half of a step of it is all that a score may be off by."""
    keyframes = out_and_back()
    submap, cloud, true = places_of(keyframes, 120)
    found = submap.search(cloud, true + np.array([0.0, 0.4, 0.0]), WINDOW_M, 0.06, MIN_LOOP_SCORE)
    assert found is not None
    assert abs(found[1] - true[1]) < CELL_M
    assert submap.search(cloud, true, WINDOW_M, 0.06, 1.0) is None
    pyramid = submap.pyramid()
    assert pyramid.levels.dtype == np.uint8
    field = pyramid.scale * pyramid.levels[0]
    assert float(field.max()) <= 1.0 + 0.5 * LIKELIHOOD_STEP
    assert abs(pyramid.scale * pyramid.empty - LOOP_UNKNOWN_LIKELIHOOD) <= 0.5 * LIKELIHOOD_STEP
