import math

import numpy as np

from service.geometry import poses as se2
from service.mapper.graph.gnss.fix_consensus import FixPath, find_consensus, fix_edges
from service.mapper.graph.model.pose_graph import Edges, PoseGraph
from service.mapper.graph.model.pose_graph_solver import solve

RNG = np.random.default_rng(3)
POSE_ODOM_ENU = np.array([12.0, -7.0, 0.9])
ANTENNA = np.array([-0.4, 0.3])


def half_circle(count: int = 60) -> FixPath:
    """Exact path of 300 m; fixes of sigma 2 m with errors of 0.5 m."""
    theta = np.linspace(0.0, math.pi, count)
    odom = np.column_stack((95.0 * np.sin(theta), 95.0 * (1.0 - np.cos(theta)), theta))
    antenna = np.tile(ANTENNA, (count, 1))
    enu = se2.points_seen(POSE_ODOM_ENU, se2.points_from(odom, antenna))
    enu += 0.5 * RNG.standard_normal(enu.shape)
    step = np.tile(np.diag([0.02**2, 0.02**2, 0.003**2]), (count, 1, 1))
    covariance = np.tile(4.0 * np.eye(2), (count, 1, 1))
    return FixPath(odom, step, 95.0 * theta, antenna, enu, covariance, np.full(count, 12.0))


def off(consensus, path: FixPath) -> float:
    """Of where the antenna should be, at most, m."""
    points = se2.points_from(path.odom, path.antenna)
    there = se2.points_seen(consensus.pose_odom_enu, points) - se2.points_seen(POSE_ODOM_ENU, points)
    return float(np.hypot(*there.T).max())


def test_a_third_that_lies_elsewhere_is_found_and_moves_nothing():
    path = half_circle()
    clean = find_consensus(path)
    path.enu[20:40] += (9.0, -5.0)
    found = find_consensus(path)
    np.testing.assert_array_equal(np.flatnonzero(~found.is_accepted), np.arange(20, 40))
    assert off(found, path) < off(clean, path) + 0.5


def test_an_interval_with_a_common_error_within_the_gate_is_rejected():
    path = half_circle()
    path.enu[20:30] += (4.5, 0.0)  # 2.2 sigma
    found = find_consensus(path)
    np.testing.assert_array_equal(np.flatnonzero(~found.is_accepted), np.arange(20, 30))


def test_edges_of_fixes_constrain_the_antenna_and_not_the_heading():
    """Two poses 40 m apart with an edge between them; fixes of their antennas rotate both."""
    base = np.array([[0.0, 0.0, 0.1], [40.0, 0.0, 0.4]])
    antenna = np.array([[2.0, 1.0], [-1.0, 3.0]])
    truth = se2.compose(np.array([5.0, 6.0, 0.3]), base)
    enu = se2.points_from(truth, antenna)
    tight = Edges(
        np.array([0]), np.array([1]), se2.between(base[:1], base[1:]), 1e-8 * np.eye(3)[None], np.zeros(1)
    )
    guess = np.array([4.0, 7.0, 0.2])
    heading = base[:, 2] + guess[2]
    fixes = fix_edges(2, np.arange(2), heading, antenna, enu, np.tile(np.eye(2), (2, 1, 1)), 0.0)
    pose_map_enu = se2.between(guess, np.zeros(3))
    solved = solve(PoseGraph(np.vstack((base, pose_map_enu)), tight.followed_by(fixes)))
    np.testing.assert_allclose(se2.between(solved.poses[2], np.zeros(3)), (5.0, 6.0, 0.3), atol=1e-3)
