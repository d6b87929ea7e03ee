"""The graph of a recorded drive with loops, as GTSAM and g2o read it."""

import g2opy
import gtsam
import numpy as np
import pytest

from service.mapper.graph.model.pose_graph import Edges, edge_chi2
from service.offline.replay.replay import replay
from service.offline.replay.result import write_replay
from service.offline.replay.setup import ReplayOptions


@pytest.fixture(scope="module")
def result(shared, tmp_path_factory):
    folder = tmp_path_factory.mktemp("result")
    write_replay(replay([shared / "cases" / "loop_good.mcap"], ReplayOptions()), folder)
    return folder


def read_lines(result, kind: str, columns: int) -> np.ndarray:
    """The numbers of all lines of one kind."""
    lines = [line.split() for line in (result / "graph.g2o").read_text().splitlines()]
    return np.array([line[1:] for line in lines if line[0] == kind], float).reshape(-1, columns)


def test_gtsam_and_g2o_read_every_edge_of_it(result):
    path = str(result / "graph.g2o")
    vertices, edges = read_lines(result, "VERTEX_SE2", 4), read_lines(result, "EDGE_SE2", 11)
    count = len(vertices), len(edges)
    assert len(edges) > len(vertices)  # odometry and two loops
    information = np.zeros((len(edges), 3, 3))
    information[:, *np.triu_indices(3)] = edges[:, 5:]
    information += np.triu(information, 1).transpose(0, 2, 1)
    of, to = edges[:, :2].T.astype(np.int64)
    as_written = Edges(of, to, edges[:, 2:5], np.linalg.inv(information), np.zeros(len(edges)))
    ours = float(edge_chi2(as_written, vertices[:, 1:]).sum())
    factors, values = gtsam.readG2o(path, False)
    assert (values.size(), factors.size()) == count
    assert 2.0 * factors.error(values) == pytest.approx(ours, rel=1e-6)
    optimizer = g2opy.SparseOptimizer()
    assert optimizer.load(path)
    optimizer.initialize_optimization()
    optimizer.compute_active_errors()
    assert (len(optimizer.vertices()), len(optimizer.edges())) == count
    assert optimizer.active_chi2() == pytest.approx(ours, rel=0.01)


def test_gtsam_finds_the_poses_of_the_replay_again(result):
    factors, values = gtsam.readG2o(str(result / "graph.g2o"), False)
    factors.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-5)))
    found = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    poses = np.array([(found.atPose2(k).x(), found.atPose2(k).y()) for k in range(found.size())])
    np.testing.assert_allclose(poses, read_lines(result, "VERTEX_SE2", 4)[:, 1:3], atol=0.02)
