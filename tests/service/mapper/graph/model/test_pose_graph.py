import numpy as np
import pytest
from scipy.optimize import least_squares

from service.geometry import poses as se2
from service.geometry.se2 import wrap_angle
from service.mapper.graph.model.pose_graph import Edges, GraphError, PoseGraph, Sightings, edge_chi2
from service.mapper.graph.model.pose_graph_solver import solve

SIGMA = np.array([0.05, 0.03, 0.02])


def ring(count: int, noise: float = 1.0, seed: int = 3) -> tuple[PoseGraph, np.ndarray]:
    """A drive once round, and an edge that closes it; the guess is the odometry. Truth beside it."""
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi * np.arange(count) / count
    truth = np.stack((10.0 * np.sin(turn), 10.0 - 10.0 * np.cos(turn), wrap_angle(turn)), axis=1)
    of, to = np.arange(count), (np.arange(count) + 1) % count
    measured = se2.compose(se2.between(truth[of], truth[to]), noise * rng.normal(0.0, SIGMA, (count, 3)))
    covariance = np.tile(np.diag(SIGMA**2), (count, 1, 1))
    covariance[:, 0, 1] = covariance[:, 1, 0] = 4e-4
    guess = [truth[0]]
    for step in measured[:-1]:
        guess.append(se2.compose(guess[-1], step))
    return PoseGraph(np.array(guess), Edges(of, to, measured, covariance, np.zeros(count))), truth


def with_landmarks(graph: PoseGraph, truth: np.ndarray, xy: np.ndarray, sigma_m: float = 0.02) -> PoseGraph:
    """Every landmark seen by every third pose."""
    rng = np.random.default_rng(4)
    of, landmark = (k.ravel() for k in np.meshgrid(np.arange(0, len(truth), 3), np.arange(len(xy))))
    seen = se2.points_seen(truth[of], xy[landmark]) + rng.normal(0.0, sigma_m, (len(of), 2))
    covariance = np.tile(sigma_m**2 * np.array([[1.0, 0.3], [0.3, 2.0]]), (len(of), 1, 1))
    sightings = Sightings(of, landmark, seen, covariance, np.zeros(len(of)))
    first = np.array([np.flatnonzero(landmark == k)[0] for k in range(len(xy))])
    guess = se2.points_from(graph.poses[of[first]], seen[first])
    return PoseGraph(graph.poses, graph.edges, guess, sightings)


def cost(graph: PoseGraph, poses: np.ndarray, landmarks: np.ndarray) -> float:
    sightings = graph.sightings
    error = se2.points_seen(poses[sightings.of], landmarks[sightings.landmark]) - sightings.xy
    of_sightings = np.einsum("ki,kij,kj", error, np.linalg.inv(sightings.covariance), error)
    return float(edge_chi2(graph.edges, poses).sum() + of_sightings)


# D3, D12
def test_odometry_and_landmark_terms_reach_the_least_squares_of_scipy():
    """Not the same pose by pose: a bearing and a range weigh an error a little differently than x and y."""
    graph, truth = ring(24)
    graph = with_landmarks(graph, truth, np.array([[3.0, 4.0], [12.0, 9.0], [-4.0, 13.0]]))
    solution = solve(graph)

    def errors(flat: np.ndarray) -> np.ndarray:
        poses = np.vstack((graph.poses[:1], flat[: 3 * 23].reshape(-1, 3)))
        landmarks = flat[3 * 23 :].reshape(-1, 2)
        edges, seen = graph.edges, graph.sightings
        apart = se2.log(se2.between(edges.measured, se2.between(poses[edges.of], poses[edges.to])))
        missed = se2.points_seen(poses[seen.of], landmarks[seen.landmark]) - seen.xy
        whiten = [np.linalg.cholesky(np.linalg.inv(c)).T for c in (*edges.covariance, *seen.covariance)]
        return np.concatenate([w @ e for w, e in zip(whiten, (*apart, *missed), strict=True)])

    best = least_squares(errors, np.concatenate((graph.poses[1:].ravel(), graph.landmarks.ravel())))
    apart = se2.between(solution.poses[1:], best.x[: 3 * 23].reshape(-1, 3))
    np.testing.assert_allclose(apart, 0.0, atol=2e-3)
    np.testing.assert_allclose(solution.landmarks, best.x[3 * 23 :].reshape(-1, 2), atol=2e-3)
    assert cost(graph, solution.poses, solution.landmarks) < 1.001 * 2.0 * best.cost
    assert cost(graph, graph.poses, graph.landmarks) > 10.0 * 2.0 * best.cost
    np.testing.assert_allclose(solution.poses[0], graph.poses[0], atol=1e-6)


def test_a_false_robust_edge_moves_nothing():
    graph, truth = ring(40, noise=0.1)
    edges = graph.edges
    false = np.array([[0.0, 0.0, 0.0]])  # pose 20 is 20 m from pose 0

    def with_false(width: float) -> float:
        more = Edges(
            np.append(edges.of, 0),
            np.append(edges.to, 20),
            np.vstack((edges.measured, false)),
            np.concatenate((edges.covariance, edges.covariance[:1])),
            np.append(edges.kernel_width, width),
        )
        poses = solve(PoseGraph(graph.poses, more)).poses
        return float(np.hypot(*(poses - truth).T[:2]).max())

    assert with_false(1.0) < 0.3
    assert with_false(0.0) > 2.0


# D11
def test_one_point_in_common_leaves_a_turn_open_and_two_do_not():
    """A point fixes two of the three freedoms of a sub-map; so there is no covariance to be had of it."""
    poses = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.5]])
    points = np.array([[2.0, 3.0], [5.0, -2.0]])

    def joined(count: int) -> PoseGraph:
        of, landmark = np.repeat([0, 1], count), np.tile(np.arange(count), 2)
        seen = se2.points_seen(poses[of], points[landmark])
        tight = np.tile(np.diag([1e-4, 1e-4]), (2 * count, 1, 1))
        sightings = Sightings(of, landmark, seen, tight, np.zeros(2 * count))
        return PoseGraph(np.add(poses, [[0, 0, 0], [0.2, 0.1, 0.1]]), Edges.none(), points[:count], sightings)

    both = solve(joined(2), covariances_of=[1])
    np.testing.assert_allclose(both.poses, poses, atol=1e-3)
    assert both.covariances[1][2, 2] < 1e-4
    assert np.isfinite(solve(joined(1)).poses).all()
    with pytest.raises(GraphError, match="2 poses, 0 edges, 1 landmarks seen 2 times cannot be solved"):
        solve(joined(1), covariances_of=[1])


def changed(graph: PoseGraph, **changes: np.ndarray) -> PoseGraph:
    edges = graph.edges
    fields = {k: changes.get(k, getattr(edges, k)) for k in Edges.__slots__}
    landmarks = changes.get("landmarks", graph.landmarks)
    return PoseGraph(changes.get("poses", graph.poses), Edges(**fields), landmarks)


def test_an_invalid_graph_is_refused_by_name():
    graph, _ = ring(4)
    wrong = graph.edges.covariance.copy()
    wrong[2, 0, 0] = -1.0
    bad_pose = graph.poses.copy()
    bad_pose[1, 0] = np.nan
    for change, message in (
        ({"poses": bad_pose}, r"poses\[1\] is \[\s*nan"),
        ({"to": np.array([1, 2, 3, 4])}, "edges.to names 4, expected 0 to 3"),
        ({"covariance": wrong}, r"edges.covariance\[2\] .* expected positive definite"),
        ({"measured": np.zeros((4, 2))}, r"edges.measured has the shape \(4, 2\), expected \(4, 3\)"),
        ({"landmarks": np.zeros((1, 2))}, "landmark 0 is seen from no pose"),
    ):
        with pytest.raises(GraphError, match=message):
            solve(changed(graph, **change))
