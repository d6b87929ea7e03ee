"""A graph as g2o text is the same graph in GTSAM and in g2o, by their own readers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import g2opy
import gtsam
import numpy as np
import pytest

from service.geometry import poses as se2
from service.mapper.graph.model.pose_graph import Edges, PoseGraph, edge_chi2, to_g2o
from tests.service.mapper.graph.model.test_pose_graph import cost, ring, with_landmarks


def in_gtsam(path: Path) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    return gtsam.readG2o(str(path), False)


def in_g2o(path: Path) -> Any:
    optimizer = g2opy.SparseOptimizer()
    assert optimizer.load(str(path))
    optimizer.initialize_optimization()
    optimizer.compute_active_errors()
    return optimizer


def test_every_edge_is_read_with_its_error(tmp_path):
    graph, truth = ring(24)
    path = tmp_path / "graph.g2o"
    path.write_text(to_g2o(graph, truth))
    ours = float(edge_chi2(graph.edges, truth).sum())
    factors, values = in_gtsam(path)
    assert (factors.size(), values.size()) == (24, 24)
    assert 2.0 * factors.error(values) == pytest.approx(ours, rel=1e-9)
    optimizer = in_g2o(path)
    assert (len(optimizer.vertices()), len(optimizer.edges())) == (24, 24)
    assert optimizer.active_chi2() == pytest.approx(ours, rel=1e-3)  # errors are small: 0.02 rad
    assert [k for k, vertex in optimizer.vertices().items() if vertex.fixed()] == [0]


def test_landmarks_are_read_by_both(tmp_path):
    graph, truth = ring(24, noise=0.1)
    graph = with_landmarks(graph, truth, np.array([[3.0, 4.0], [12.0, 9.0]]))
    path = tmp_path / "graph.g2o"
    path.write_text(to_g2o(graph, truth))
    ours = cost(graph, truth, graph.landmarks)
    count = len(graph.edges.of) + len(graph.sightings.of)
    factors, values = in_gtsam(path)
    assert (factors.size(), values.size()) == (count, 26)
    optimizer = in_g2o(path)
    assert (len(optimizer.edges()), len(optimizer.vertices())) == (count, 26)
    assert optimizer.active_chi2() == pytest.approx(ours, rel=0.01)


def test_a_bearing_and_a_range_weigh_a_point_as_its_covariance_does(tmp_path):
    """Where the covariance is the same in all directions, as that of every landmark that corridor makes."""
    graph, truth = ring(24, noise=0.1)
    graph = with_landmarks(graph, truth, np.array([[3.0, 4.0], [12.0, 9.0]]))
    even = np.tile(np.diag([4e-4, 4e-4]), (len(graph.sightings.of), 1, 1))
    graph = replace(graph, sightings=replace(graph.sightings, covariance=even))
    path = tmp_path / "graph.g2o"
    path.write_text(to_g2o(graph, truth))
    factors, values = in_gtsam(path)
    assert 2.0 * factors.error(values) == pytest.approx(cost(graph, truth, graph.landmarks), rel=0.01)


def test_errors_are_those_of_the_exponential_map_as_in_gtsam_and_not_of_g2o(tmp_path):
    """An edge with a residual of 1 rad distinguishes them: docs/exporting.md lists which is which."""
    measured, found = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    edges = Edges(np.array([0]), np.array([1]), measured, np.eye(3)[None] * 0.01, np.zeros(1))
    path = tmp_path / "graph.g2o"
    path.write_text(to_g2o(PoseGraph(found, edges)))
    factors, values = in_gtsam(path)
    off = se2.between(measured[0], found[1])
    assert 2.0 * factors.error(values) == pytest.approx(float(edge_chi2(edges, found)[0]))
    assert in_g2o(path).active_chi2() == pytest.approx(float((off @ off) / 0.01))
    assert abs(edge_chi2(edges, found)[0] - (off @ off) / 0.01) > 5.0


def test_a_landmark_at_a_pose_itself_has_a_finite_weight(tmp_path):
    graph, truth = ring(6, noise=0.1)
    graph = with_landmarks(graph, truth, truth[:1, :2])
    graph.sightings.xy[0] = 0.0
    path = tmp_path / "graph.g2o"
    path.write_text(to_g2o(graph, truth))
    lines = [line.split() for line in path.read_text().splitlines() if line.startswith("BR")]
    numbers = np.array([line[3:] for line in lines], float)
    assert np.isfinite(numbers).all()
    assert (numbers[:, 2:] > 0.0).all()
