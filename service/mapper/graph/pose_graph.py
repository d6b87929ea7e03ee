"""Poses and points that agree best with what was measured between them: the one door to GTSAM's solver.

Plain arrays in, plain arrays out, nothing kept between two calls. The same arrays give the same result, bit
for bit, in every process: GTSAM's wheels have no threads, and factors and unknowns are ordered by the arrays.

Source: paper 004, eq. 3-5 (odometry and landmark terms); Dellaert and Kaess, Factor graphs for robot
perception, 2017.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from service.errors import CorridorError
from service.geometry import poses as se2

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class GraphError(CorridorError):
    """A graph that cannot be solved; the message says which part and why."""


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """E measured poses of `to` in the frame of `of`: measured[k] ~ pose[of[k]]^-1 @ pose[to[k]].

    of, to         (E,) int64
    measured       (E, 3) float64   m, m, rad
    covariance     (E, 3, 3)        m^2, m rad, rad^2; in the axes of `to`
    kernel_width   (E,) float64     Cauchy kernel in sigmas: an edge that errs by more counts less and less;
                                    0: plain least squares
    """

    of: Ints
    to: Ints
    measured: Floats
    covariance: Floats
    kernel_width: Floats

    def and_also(self, more: "Edges") -> "Edges":
        """These edges, and behind them others."""
        return Edges(
            *(np.concatenate((getattr(self, name), getattr(more, name))) for name in Edges.__slots__)
        )

    @staticmethod
    def none() -> "Edges":
        return Edges(
            np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """S points seen from poses: xy[k] ~ pose[of[k]]^-1 @ landmark[landmark[k]].

    of             (S,) int64       pose
    landmark       (S,) int64
    xy             (S, 2) float64   m, in the frame of the pose
    covariance     (S, 2, 2)        m^2, in the frame of the pose
    kernel_width   (S,) float64     as in Edges
    """

    of: Ints
    landmark: Ints
    xy: Floats
    covariance: Floats
    kernel_width: Floats

    @staticmethod
    def none() -> "Sightings":
        return Sightings(
            np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0)
        )


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """What is to be solved, and where to begin.

    poses       (N, 3) float64   first guess, map frame; N > 0
    edges       between poses
    landmarks   (L, 2) float64   first guess, m, map frame
    sightings   of landmarks from poses
    fixed       the pose that stays where it is
    """

    poses: Floats
    edges: Edges
    landmarks: Floats = field(default_factory=lambda: np.empty((0, 2)))
    sightings: Sightings = field(default_factory=Sightings.none)
    fixed: int = 0


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """When Levenberg-Marquardt ends."""

    most_iterations: int = 50
    least_gain: float = 1e-6  # ends when a step lowers the cost by less than this part of it


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """poses (N, 3), landmarks (L, 2); chi2 of each edge and sighting without its kernel, (E,) and (S,).

    islands       how many groups of poses hang together with the fixed one by nothing. Nothing can move such
                  a group against the rest, so its first pose is held where it was
    covariances   by pose asked for: (3, 3), in the axes of that pose, against the fixed pose
    """

    poses: Floats
    landmarks: Floats
    edge_chi2: Floats
    sighting_chi2: Floats
    iterations: int
    islands: int
    covariances: dict[int, Floats]


def solve(
    graph: PoseGraph, config: SolverConfig | None = None, covariances_of: Sequence[int] = ()
) -> Solution:
    """Levenberg-Marquardt from the first guess. Raises GraphError, never what GTSAM raises.

    A direction that nothing measures stays where the guess had it; only a covariance asked of it is refused.
    """
    config = config or SolverConfig()
    _check(graph)
    held = _held(graph)
    # Imported here, for only a process that solves is to pay for it: 40 MB, and 0.35 s.
    from service.mapper.graph.levenberg_marquardt import solve_held

    try:
        poses, landmarks, covariances, iterations = solve_held(graph, held, config, covariances_of)
    except RuntimeError as error:
        raise GraphError(f"pose graph: {_size(graph)} cannot be solved: {_first_line(error)}") from error
    if not (np.isfinite(poses).all() and np.isfinite(landmarks).all()):
        raise GraphError(f"pose graph: {_size(graph)} ran away from the first guess; look at its edges")
    return Solution(
        poses,
        landmarks,
        edge_chi2(graph.edges, poses),
        sighting_chi2(graph.sightings, poses, landmarks),
        iterations,
        len(held) - 1,
        covariances,
    )


def edge_chi2(edges: Edges, poses: Floats) -> Floats:
    """(E,) squared error of each edge in sigmas, at some poses (N, 3)."""
    relative = se2.between(poses[edges.of], poses[edges.to])
    error = se2.log(se2.between(edges.measured, relative))
    return _squared_in_sigmas(error, edges.covariance)


def sighting_chi2(sightings: Sightings, poses: Floats, landmarks: Floats) -> Floats:
    """(S,) squared error of each sighting in sigmas, at some poses (N, 3) and landmarks (L, 2)."""
    error = se2.points_seen(poses[sightings.of], landmarks[sightings.landmark]) - sightings.xy
    return _squared_in_sigmas(error, sightings.covariance)


def _squared_in_sigmas(error: Floats, covariance: Floats) -> Floats:
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.asarray(np.einsum("ki,ki->k", error, solved))


def _held(graph: PoseGraph) -> list[int]:
    """The fixed pose, and the first pose of every group that hangs together with it by nothing."""
    count = len(graph.poses)
    parent = list(range(count + len(graph.landmarks)))

    def root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    pairs = zip(
        np.concatenate((graph.edges.of, graph.sightings.of)).tolist(),
        np.concatenate((graph.edges.to, count + graph.sightings.landmark)).tolist(),
        strict=True,
    )
    for a, b in pairs:
        low, high = sorted((root(a), root(b)))
        parent[high] = low
    anchors = {root(graph.fixed): graph.fixed}
    for k in range(count):
        anchors.setdefault(root(k), k)
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


def to_g2o(graph: PoseGraph, poses: Floats | None = None, landmarks: Floats | None = None) -> str:
    """The graph as g2o text, at a solution or at its first guess: VERTEX_SE2, EDGE_SE2 and their XY kin.

    Landmarks are numbered after the poses. Robust kernels have no place in the format.
    """
    poses = graph.poses if poses is None else poses
    landmarks = graph.landmarks if landmarks is None else landmarks
    edges, sightings = graph.edges, graph.sightings
    lines = [f"VERTEX_SE2 {k} {_numbers(pose)}" for k, pose in enumerate(poses)]
    lines += [f"VERTEX_XY {len(poses) + k} {_numbers(xy)}" for k, xy in enumerate(landmarks)]
    lines.append(f"FIX {graph.fixed}")
    upper3, upper2 = np.triu_indices(3), np.triu_indices(2)
    for of, to, measured, covariance in zip(
        edges.of, edges.to, edges.measured, edges.covariance, strict=True
    ):
        information = np.linalg.inv(covariance)[upper3]
        lines.append(f"EDGE_SE2 {of} {to} {_numbers(measured)} {_numbers(information)}")
    for of, landmark, xy, covariance in zip(
        sightings.of, sightings.landmark, sightings.xy, sightings.covariance, strict=True
    ):
        information = np.linalg.inv(covariance)[upper2]
        lines.append(f"EDGE_SE2_XY {of} {len(poses) + landmark} {_numbers(xy)} {_numbers(information)}")
    return "\n".join(lines) + "\n"


def _numbers(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in values)
