"""Solves a pose graph: validates it, fixes disconnected groups, and reports errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.geometry import poses as se2
from service.geometry.groups import groups_of
from service.geometry.poses import Floats
from service.mapper.graph.model.pose_graph import (
    UNKNOWN_COVARIANCE,
    Edges,
    GraphError,
    PoseGraph,
    SolverConfig,
)


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """poses (N, 3), landmarks (L, 2): m and rad, map frame.

    covariances   by requested pose: (3, 3), in the axes of that pose, against the fixed pose
    """

    poses: Floats
    landmarks: Floats
    covariances: dict[int, Floats]


def solve(
    graph: PoseGraph, config: SolverConfig | None = None, covariances_of: Sequence[int] = ()
) -> Solution:
    """Solution by Levenberg-Marquardt from the first guess. Raises GraphError, never an exception of GTSAM.

    Unmeasured directions keep the first guess, and so does the first pose of a group that no edge joins to
    the fixed pose; a covariance requested for it is refused.
    """
    config = config or SolverConfig()
    _check(graph)
    fixed_poses = _fixed_poses(graph)
    # Imported here to spare other processes 40 MB and 0.35 s.
    from service.mapper.graph.model.gtsam_solver import solve_with_fixed

    try:
        poses, landmarks, covariances = solve_with_fixed(graph, fixed_poses, config, covariances_of)
    except RuntimeError as error:
        raise GraphError(f"pose graph: {_size(graph)} cannot be solved: {_first_line(error)}") from error
    if not (np.isfinite(poses).all() and np.isfinite(landmarks).all()):
        raise GraphError(f"pose graph: {_size(graph)} ran away from the first guess; look at its edges")
    return Solution(poses, landmarks, covariances)


def covariance_of(graph: PoseGraph, k: int) -> Floats:
    """(3, 3) marginal covariance of pose k against the fixed one, in its own axes. Raises GraphError.

    Unlike in `solve`, its factorization is QR (Dellaert and Kaess, section 4.3), which stays accurate where
    one step is known to 0.1 mm and another not at all. Missing steps of the chain get an edge of
    UNKNOWN_COVARIANCE.
    """
    _check(graph)
    poses, edges = graph.poses, graph.edges
    to = np.setdiff1d(np.arange(1, len(poses)), edges.to[edges.to == edges.of + 1])
    step = se2.between(poses[to - 1], poses[to])
    missing = Edges(to - 1, to, step, np.tile(UNKNOWN_COVARIANCE, (len(to), 1, 1)), np.zeros(len(to)))
    from service.mapper.graph.model.gtsam_solver import marginal_of

    try:
        found = marginal_of(replace(graph, edges=edges.followed_by(missing)), k)
    except RuntimeError as error:
        raise GraphError(f"pose graph: pose {k} has no covariance: {_first_line(error)}") from error
    return np.asarray(0.5 * (found + found.T), np.float64)


def _fixed_poses(graph: PoseGraph) -> list[int]:
    """The fixed pose, and the first pose of every group disconnected from it."""
    count, edges, sightings = len(graph.poses), graph.edges, graph.sightings
    seen = np.column_stack((sightings.of, count + sightings.landmark))
    pairs = np.concatenate((np.column_stack((edges.of, edges.to)), seen))
    group = groups_of(count + len(graph.landmarks), pairs).tolist()
    anchors = {group[graph.fixed]: graph.fixed}
    for k in range(count):
        anchors.setdefault(group[k], k)
    return list(anchors.values())


def _check(graph: PoseGraph) -> None:
    pose_count, landmark_count = len(graph.poses), len(graph.landmarks)
    edges, sightings = graph.edges, graph.sightings
    for name, array, shape in (
        ("poses", graph.poses, (pose_count, 3)),
        ("landmarks", graph.landmarks, (landmark_count, 2)),
        ("edges.measured", edges.measured, (len(edges.of), 3)),
        ("edges.kernel_width", edges.kernel_width, (len(edges.of),)),
        ("sightings.xy", sightings.xy, (len(sightings.of), 2)),
        ("sightings.kernel_width", sightings.kernel_width, (len(sightings.of),)),
    ):
        if array.shape != shape:
            raise GraphError(f"pose graph: {name} has the shape {array.shape}, expected {shape}")
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise GraphError(f"pose graph: {name}[{row}] is {array[row]}, expected finite numbers")
    for name, index, count in (
        ("edges.of", edges.of, pose_count),
        ("edges.to", edges.to, pose_count),
        ("sightings.of", sightings.of, pose_count),
        ("sightings.landmark", sightings.landmark, landmark_count),
        ("fixed", np.array([graph.fixed]), pose_count),
    ):
        wrong = np.flatnonzero((index < 0) | (index >= count))
        if len(wrong):
            raise GraphError(f"pose graph: {name} names {int(index[wrong[0]])}, expected 0 to {count - 1}")
    _check_covariances("edges", edges.covariance, len(edges.of), 3)
    _check_covariances("sightings", sightings.covariance, len(sightings.of), 2)
    unseen = np.setdiff1d(np.arange(landmark_count), sightings.landmark)
    if len(unseen):
        raise GraphError(f"pose graph: landmark {int(unseen[0])} is seen from no pose; leave it out")


def _check_covariances(name: str, covariance: Floats, count: int, size: int) -> None:
    if covariance.shape != (count, size, size):
        expected = (count, size, size)
        raise GraphError(
            f"pose graph: {name}.covariance has the shape {covariance.shape}, expected {expected}"
        )
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        eigenvalues = np.linalg.eigvalsh(np.nan_to_num(covariance))
        row = int(np.argmin(eigenvalues[:, 0]))
        raise GraphError(
            f"pose graph: {name}.covariance[{row}] is {covariance[row].tolist()}, expected positive definite"
        ) from None


def _size(graph: PoseGraph) -> str:
    return (
        f"{len(graph.poses)} poses, {len(graph.edges.of)} edges, "
        f"{len(graph.landmarks)} landmarks seen {len(graph.sightings.of)} times"
    )


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
