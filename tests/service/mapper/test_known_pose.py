"""Covariance of a pose in the map, from a key frame corrected by a graph."""

import math

import numpy as np
import pytest

from service.estimator.motion import Motion
from service.geometry.se2 import SE2
from service.mapper.judgement import MAX_DRIFT_M, drift_of
from service.mapper.known_pose import KnownPose, carried, covariance_added

BY_STEP = np.diag([4e-4, 1e-4, 1e-5])


def walked(steps: int, before: np.ndarray, step: SE2) -> np.ndarray:
    """(3, 3) after steps that each add BY_STEP at their ends, by the errors themselves: x -> step^-1 x."""
    covariance = before
    c, s = math.cos(step.theta_rad), math.sin(step.theta_rad)
    move = np.array(
        [[c, s, s * step.x_m - c * step.y_m], [-s, c, c * step.x_m + s * step.y_m], [0.0, 0.0, 1.0]]
    )
    for _ in range(steps):
        covariance = move @ covariance @ move.T + BY_STEP
    return covariance


def test_after_a_correction_the_covariance_is_that_of_the_graph_and_of_the_path_since():
    step = SE2(0.3, 0.0, 0.05)
    by_motion = walked(200, np.zeros((3, 3)), step)
    by_graph = np.diag([1e-4, 1e-4, 1e-5])
    known = KnownPose(SE2(2.0, 1.0, 0.3), by_motion, by_graph)
    now, pose = walked(10, by_motion, step), known.pose_odom_base
    for _ in range(10):
        pose = pose @ step
    found = known.covariance_at(Motion(pose, (0.0, 0.0, 0.0), now))
    np.testing.assert_allclose(found, walked(10, by_graph, step), atol=1e-9)
    assert np.trace(found) < 0.1 * np.trace(now)


@pytest.mark.parametrize("seed", range(5))
def test_the_covariance_of_a_single_pose_equals_that_of_the_arrays(seed):
    """Whether motion has added covariance in all directions, or seems to have reduced some."""
    random = np.random.default_rng(seed)
    roots = random.normal(size=(3, 40, 3, 3)) * (0.1, 0.1, 0.01)
    before, after, by_graph = roots @ np.swapaxes(roots, -1, -2)
    steps = random.normal(size=(40, 3)) * (3.0, 3.0, 2.0)
    expected = carried(by_graph, steps) + covariance_added(before, after, steps)
    for k, step in enumerate(steps):
        known = KnownPose(SE2(2.0, -1.0, 0.3), before[k], by_graph[k])
        motion = Motion(known.pose_odom_base @ SE2(*step), (0.0, 0.0, 0.0), after[k])
        np.testing.assert_allclose(known.covariance_at(motion), expected[k], rtol=0.0, atol=1e-12)


def test_a_drifted_pose_is_not_ok_and_the_reason_gives_its_sigma():
    assert drift_of(np.diag([0.9 * MAX_DRIFT_M, 0.1, 0.1]) ** 2) == ""
    assert "1.20 m and 5.7 deg" in drift_of(np.diag([0.1, 1.2, 0.1]) ** 2)
    assert "11.5 deg" in drift_of(np.diag([0.1, 0.1, 0.2]) ** 2)
    assert "in the map it is not known; drive" in drift_of(np.diag([0.1, 1008.0, 0.2]) ** 2)
