"""A sub-map is found at its true pose, also where the two passes saw different ground."""

import math

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.kernels.loops import thin_points
from service.kernels.normals import estimate_normals
from service.mapper.graph.model import candidate_submap
from service.mapper.graph.model.candidate_submap import MIN_LOOP_SCORE, CandidateSubmap, cloud_of
from service.mapper.graph.model.keyframe_list import KeyFrame, KeyframeList, ThinnedScan
from service.mapper.graph.model.loops import loop_of
from service.mapper.graph.model.point_clouds import PointCloud, SurfelSet, cloud_with_noise, joined
from tests.service.mapper.drives import cast

DOORS_M = (4.0, 11.5, 17.0, 25.5, 31.0, 38.5)  # each 0.9 m wide, its leaf sunk by 0.15 m
HALF_M, SUNK_M, END_M = 1.0, 0.15, 45.0
FIRST_RAD, STEP_RAD, BEAMS = -0.75 * math.pi, math.radians(0.5), 541  # blind behind, as most lasers are
STEP_M = 0.3
OFF_M, WINDOW_M = 0.2, 1.0  # by how much odometry is wrong, and what is searched


Walls = list[tuple[float, float, float, float]]


def corridor() -> Walls:
    walls = [(0.0, -HALF_M, END_M, -HALF_M)]
    x = 0.0
    for door in DOORS_M:
        leaf = HALF_M + SUNK_M
        walls += [(x, HALF_M, door, HALF_M), (door, HALF_M, door, leaf)]
        walls += [(door, leaf, door + 0.9, leaf), (door + 0.9, leaf, door + 0.9, HALF_M)]
        x = door + 0.9
    return [*walls, (x, HALF_M, END_M, HALF_M)]


def out_and_back_in(walls: Walls, sigma_m: float) -> KeyframeList:
    """From x = 8 to 34 m and back, in key frames whose poses in odom are true."""
    noise = np.random.default_rng(7)
    there = np.arange(8.0, 34.0, STEP_M)
    poses = [SE2(x, 0.0, 0.0) for x in there] + [SE2(x, 0.0, math.pi) for x in there[::-1]]
    keyframes = KeyframeList()
    angle = FIRST_RAD + STEP_RAD * np.arange(BEAMS)
    for k, pose in enumerate(poses):
        paths = np.column_stack((np.cos(angle + pose.theta_rad), np.sin(angle + pose.theta_rad)))
        range_m = cast(walls, np.tile([pose.x_m, pose.y_m], (BEAMS, 1)), paths)
        seen = range_m < 20.0
        range_m = range_m[seen] + sigma_m * noise.standard_normal(int(seen.sum()))
        xy = np.column_stack((range_m * np.cos(angle[seen]), range_m * np.sin(angle[seen])))
        normals, kept = np.empty((len(xy), 3)), np.empty(len(xy), np.bool_)
        estimate_normals(xy, np.zeros(2), STEP_RAD, sigma_m, 1.0, normals, np.empty((len(xy), 2)))
        thin_points(xy, 0.04, kept)
        nothing = np.zeros((0, 2), np.float32)
        frame = KeyFrame(k * 10**8, pose, np.eye(3), 0, 0.9, False, nothing, (0.0, 0.0), STEP_RAD, sigma_m)
        thinned = ThinnedScan(xy[kept].astype(np.float32), normals[kept].astype(np.float32), (0.0, 0.0))
        keyframes.append(frame, np.array([pose.x_m, pose.y_m, pose.theta_rad]), thinned)
    return keyframes


@pytest.fixture(scope="module")
def out_and_back() -> KeyframeList:
    return out_and_back_in(corridor(), 0.012)


@pytest.fixture(scope="module")
def in_a_bare_corridor() -> KeyframeList:
    bare = [(-40.0, -HALF_M, 80.0, -HALF_M), (-40.0, HALF_M, 80.0, HALF_M)]
    return out_and_back_in(bare, 0.04)


def places_of(keyframes: KeyframeList, last: int) -> tuple[CandidateSubmap, PointCloud, Floats]:
    """The outward path, the last 5 m of the return path up to a key frame, and the pose of these."""
    reach = round(5.0 / STEP_M)
    reference = last - reach // 2
    outward = np.arange(keyframes.count // 2)
    near = int(outward[np.argmin(abs(keyframes.odom[outward, 0] - keyframes.odom[reference, 0]))])
    submap = CandidateSubmap(keyframes, range(near - reach, near + reach + 1), near)
    cloud = cloud_of(keyframes, range(last - reach, last + 1), reference)
    return submap, cloud, se2.between(keyframes.odom[near], keyframes.odom[reference])


def found_m(keyframes: KeyframeList, last: int) -> float:
    """How far along the corridor they are found from where they are."""
    submap, cloud, true = places_of(keyframes, last)
    guess = true + np.array([OFF_M, 0.0, 0.0])
    pose = submap.search(cloud, guess, WINDOW_M, 0.06, MIN_LOOP_SCORE)
    assert pose is not None
    return float(submap.align(cloud, pose).pose[0] - true[0])


BACK = range(106, 130, 4)  # key frames of the return path, from 28 m on, with a door within 5 m


def test_unknown_ground_is_not_neutral_in_a_search(
    out_and_back: KeyframeList, monkeypatch: pytest.MonkeyPatch
):
    """Counted against a place, unknown ground puts the two passes on top of each other."""
    monkeypatch.setattr(candidate_submap, "LOOP_UNKNOWN_LIKELIHOOD", 0.0)
    off_m = [found_m(out_and_back, last) for last in BACK]
    assert max(map(abs, off_m)) > 0.1, off_m


def test_along_a_bare_corridor_the_expected_pose_applies(in_a_bare_corridor: KeyframeList):
    """Wherever a search has put it: the walls fix it across, nothing along, and the covariance shows that."""
    for last in BACK:
        submap, cloud, true = places_of(in_a_bare_corridor, last)
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
