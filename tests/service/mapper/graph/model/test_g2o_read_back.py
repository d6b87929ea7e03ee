"""A graph as g2o text is the same graph in GTSAM and in g2o, by their own readers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import g2opy
import gtsam
import numpy as np
import pytest

from service.mapper.graph.model.pose_graph import edge_chi2, to_g2o
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
    path.write_text(to_g2o(replace(graph, poses=truth)))
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
    path.write_text(to_g2o(replace(graph, poses=truth)))
    ours = cost(graph, truth, graph.landmarks)
    count = len(graph.edges.of) + len(graph.sightings.of)
    factors, values = in_gtsam(path)
    assert (factors.size(), values.size()) == (count, 26)
    optimizer = in_g2o(path)
    assert (len(optimizer.edges()), len(optimizer.vertices())) == (count, 26)
    assert optimizer.active_chi2() == pytest.approx(ours, rel=0.01)
