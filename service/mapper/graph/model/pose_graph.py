"""Pose graphs: poses and landmarks with measurements between them, and their g2o text.

Arrays in, arrays out, without state between calls. The same arrays give the same result, bit for bit, in
every process: GTSAM's wheels have no threads, and factors and unknowns are ordered by the arrays.

Source: Zhang et al. 2016, eq. 3-5 (odometry and landmark terms); Dellaert and Kaess, Factor graphs for robot
perception, 2017.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from service.errors import CorridorError
from service.geometry import poses as se2
from service.geometry.poses import Floats

UNKNOWN_COVARIANCE = np.diag([1e3, 1e3, 10.0])  # m^2, rad^2: of an unmeasured step
MIN_BEARING_RANGE_M = 1e-3  # of a bearing in a g2o file

Ints = npt.NDArray[np.int64]


class GraphError(CorridorError):
    """A graph cannot be solved; the message gives the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """E measured poses of `to` in the frame of `of`: measured[k] ~ pose[of[k]]^-1 @ pose[to[k]].

    of, to         (E,) int64
    measured       (E, 3) float64   m, m, rad
    covariance     (E, 3, 3)        m^2, m rad, rad^2; in the axes of `to`
    kernel_width   (E,) float64     Cauchy kernel in sigmas; 0: least squares
    """

    of: Ints
    to: Ints
    measured: Floats
    covariance: Floats
    kernel_width: Floats

    def followed_by(self, more: "Edges") -> "Edges":
        """These edges, then others."""
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
    """Unknowns with a first guess, and the measurements between them.

    poses       (N, 3) float64   first guess, map frame; N > 0
    edges       between poses
    landmarks   (L, 2) float64   first guess, m, map frame
    sightings   of landmarks from poses
    fixed       index of the fixed pose
    """

    poses: Floats
    edges: Edges
    landmarks: Floats = field(default_factory=lambda: np.empty((0, 2)))
    sightings: Sightings = field(default_factory=Sightings.none)
    fixed: int = 0


@dataclass(frozen=True, slots=True)
class SolverConfig:
    """Termination of Levenberg-Marquardt."""

    most_iterations: int = 50
    least_gain: float = 1e-6  # ends at a relative decrease of the cost below it


def edge_chi2(edges: Edges, poses: Floats) -> Floats:
    """(E,) squared Mahalanobis residual of each edge at poses (N, 3)."""
    relative = se2.between(poses[edges.of], poses[edges.to])
    error = se2.log(se2.between(edges.measured, relative))
    solved = np.linalg.solve(edges.covariance, error[..., None])[..., 0]
    return np.asarray(np.einsum("ki,ki->k", error, solved))


def to_g2o(graph: PoseGraph) -> str:
    """The graph as g2o text, at its first guess: VERTEX_SE2, EDGE_SE2, VERTEX_XY, EDGE_SE2_XY.

    Landmarks are numbered after the poses. Each sighting is written twice: as EDGE_SE2_XY for g2o and as BR
    (bearing and range) for GTSAM; each skips the other. FIX comes last: GTSAM 4.3 reads no edge after it. The
    format has no robust kernels.
    """
    poses, edges, sightings = graph.poses, graph.edges, graph.sightings
    lines = [f"VERTEX_SE2 {k} {_numbers(pose)}" for k, pose in enumerate(poses)]
    lines += [f"VERTEX_XY {len(poses) + k} {_numbers(xy)}" for k, xy in enumerate(graph.landmarks)]
    upper3, upper2 = np.triu_indices(3), np.triu_indices(2)
    for of, to, measured, covariance in zip(
        edges.of, edges.to, edges.measured, edges.covariance, strict=True
    ):
        information = np.linalg.inv(covariance)[upper3]
        lines.append(f"EDGE_SE2 {of} {to} {_numbers(measured)} {_numbers(information)}")
    for of, landmark, xy, covariance in zip(
        sightings.of, sightings.landmark, sightings.xy, sightings.covariance, strict=True
    ):
        ends, information = f"{of} {len(poses) + landmark}", np.linalg.inv(covariance)[upper2]
        lines.append(f"EDGE_SE2_XY {ends} {_numbers(xy)} {_numbers(information)}")
        bearing_rad, range_m, of_both = bearing_range(xy, covariance)
        lines.append(f"BR {ends} {_numbers(np.array([bearing_rad, range_m, *np.sqrt(np.diag(of_both))]))}")
    lines.append(f"FIX {graph.fixed}")
    return "\n".join(lines) + "\n"


def bearing_range(xy: Floats, covariance: Floats) -> tuple[float, float, Floats]:
    """Bearing rad and range m of a point (2,) m, and their covariance (2, 2) by that of the point.

    A point nearer than MIN_BEARING_RANGE_M is moved straight ahead to that range.
    """
    range_m = float(np.hypot(*xy))
    if range_m < MIN_BEARING_RANGE_M:
        xy, range_m = np.array([MIN_BEARING_RANGE_M, 0.0]), MIN_BEARING_RANGE_M
    to_polar = np.array([[-xy[1] / range_m, xy[0] / range_m], [xy[0], xy[1]]]) / range_m
    return float(np.arctan2(xy[1], xy[0])), range_m, to_polar @ covariance @ to_polar.T


def _numbers(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in values)
