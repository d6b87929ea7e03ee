"""The covariance of a pose of a chain with loops, against that of a solution and where that has none."""

import numpy as np
import pytest

from service.geometry import poses as se2
from service.mapper.graph.model.pose_graph import Edges, PoseGraph, Sightings
from service.mapper.graph.model.pose_graph_solver import covariance_of, solve

COUNT = 40


def chain(loops: list[tuple[int, int]], seed: int = 1) -> PoseGraph:
    """A winding path with consistent edges and covariances of any shape."""
    random = np.random.default_rng(seed)
    poses = np.zeros((COUNT, 3))
    for k in range(1, COUNT):
        poses[k] = se2.compose(poses[k - 1], np.array([0.3, 0.02, random.normal(0.0, 0.1)]))
    of = np.array([*range(COUNT - 1), *(a for a, _ in loops)])
    to = np.array([*range(1, COUNT), *(b for _, b in loops)])
    roots = random.normal(size=(len(of), 3, 3)) * np.array([0.01, 0.01, 0.003])
    covariance = np.swapaxes(roots, 1, 2) @ roots + 1e-6 * np.eye(3)
    width = np.r_[np.zeros(COUNT - 1), np.full(len(loops), 2.0)]
    return PoseGraph(poses, Edges(of, to, se2.between(poses[of], poses[to]), covariance, width))


@pytest.mark.parametrize("loops", [[], [(0, 39)], [(3, 30), (5, 33), (10, 21), (2, 39), (0, 14)]])
def test_it_is_what_a_solver_gives(loops: list[tuple[int, int]]):
    graph = chain(loops)
    expected = solve(graph, covariances_of=[25, COUNT - 1]).covariances
    for k in (25, COUNT - 1):
        np.testing.assert_allclose(covariance_of(graph, k), expected[k], rtol=1e-3, atol=1e-9)


def pairs_of(graph: PoseGraph, ends: list[tuple[int, int]], seed: int = 2) -> PoseGraph:
    """The graph with points that both poses of each pair saw, in front of and beside them."""
    random = np.random.default_rng(seed)
    landmarks = np.array([graph.poses[a, :2] + random.normal(0.0, 4.0, 2) for a, _ in ends])
    of, which = np.array(ends).ravel(), np.repeat(np.arange(len(ends)), 2)
    roots = random.normal(0.0, 0.02, (len(of), 2, 2))
    covariance = roots @ np.swapaxes(roots, 1, 2) + 1e-4 * np.eye(2)
    xy = se2.points_seen(graph.poses[of], landmarks[which])
    seen = Sightings(of, which, xy, covariance, np.zeros(len(of)))
    return PoseGraph(graph.poses, graph.edges, landmarks, seen)


@pytest.mark.parametrize("loops", [[], [(3, 30)]])
@pytest.mark.parametrize("pairs", [[(0, 39)], [(2, 25), (0, 20), (7, 39)]])
def test_shared_landmarks_give_the_covariance_of_the_last_pose(
    loops: list[tuple[int, int]], pairs: list[tuple[int, int]]
):
    graph = pairs_of(chain(loops), pairs)
    expected = solve(graph, covariances_of=[COUNT - 1]).covariances[COUNT - 1]
    np.testing.assert_allclose(covariance_of(graph, COUNT - 1), expected, rtol=1e-3, atol=1e-9)
    assert np.trace(expected) < 0.9 * np.trace(covariance_of(chain(loops), COUNT - 1))
