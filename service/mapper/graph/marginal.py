"""How well the last pose of a chain with loops is known against the first."""

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.pose_graph import Ints, PoseGraph, edge_chi2

MOST_LOOPS = 100  # the newest ones; what the others say is left out, and the covariance no smaller by them
MOST_PAIRS = 100  # the newest ones, likewise
OPEN_COVARIANCE = np.diag([1e3, 1e3, 10.0])  # m^2, rad^2: of a step that nothing measures


def covariance_of_last(graph: PoseGraph, last: int) -> Floats:
    """(3, 3) of pose `last` against pose 0, in its own axes, at the poses as they are.

    Edges count, and landmarks that were seen twice: a point of one pose that is a point of another.

    In the axes of pose 0 the errors along a chain of steps add up, so any two of its poses share the error
    up to the earlier one. Every edge that is no step measures a difference of two such errors, and two
    sightings of a point two of its components; all are taken in at once (Barfoot, State Estimation for
    Robotics, 2017, section 3.3). Unlike a solver's marginals it is well conditioned where steps are known to
    0.1 mm and one of them is not known at all.
    """
    edges = graph.edges
    inside = (edges.of <= last) & (edges.to <= last)
    at_origin = se2.adjoint(se2.between(graph.poses[:1], graph.poses))
    moved = at_origin[edges.to]
    covariance = moved @ edges.covariance @ moved.transpose(0, 2, 1)
    has_kernel = edges.kernel_width > 0.0  # Cauchy: what errs by more counts less
    off = edge_chi2(edges, graph.poses)[has_kernel] / edges.kernel_width[has_kernel] ** 2
    covariance[has_kernel] *= (1.0 + off)[:, None, None]

    step = at_origin @ OPEN_COVARIANCE @ at_origin.transpose(0, 2, 1)
    steps = np.flatnonzero(inside & (edges.to == edges.of + 1))
    _, first = np.unique(edges.to[steps], return_index=True)
    steps = steps[first]
    step[edges.to[steps]] = covariance[steps]
    step[0] = 0.0
    along = np.cumsum(step, axis=0)  # (N, 3, 3) of each pose, by the chain alone

    is_loop = inside.copy()
    is_loop[steps] = False
    loops = np.flatnonzero(is_loop)
    loops = loops[np.argsort(edges.to[loops], kind="stable")][-MOST_LOOPS:]
    pair_of, pair_to, pair_rows, pair_covariance = _pairs(graph, last)
    of, to = np.concatenate((edges.of[loops], pair_of)), np.concatenate((edges.to[loops], pair_to))
    known = along[last]
    if len(of):
        rows = np.concatenate((np.tile(np.eye(3), (len(loops), 1, 1)), pair_rows))
        shared = (
            _shared(along, to, to) - _shared(along, to, of) - _shared(along, of, to) + _shared(along, of, of)
        )
        shared = rows[:, None] @ shared @ rows[None].transpose(0, 1, 3, 2)
        shared[np.arange(len(of)), np.arange(len(of))] += np.concatenate((covariance[loops], pair_covariance))
        size = 3 * len(of)
        with_last = ((along[to] - along[of]) @ rows.transpose(0, 2, 1)).transpose(1, 0, 2).reshape(3, size)
        measured = shared.transpose(0, 2, 1, 3).reshape(size, size)
        known = known - with_last @ np.linalg.solve(measured, with_last.T)
    back = se2.adjoint(se2.between(graph.poses[last], graph.poses[0]))
    found = back @ known @ back.T
    return np.asarray(0.5 * (found + found.T), np.float64)


def _pairs(graph: PoseGraph, last: int) -> tuple[Ints, Ints, Floats, Floats]:
    """The poses (P,) and (P,) up to `last` that saw the same point; what takes the difference of their
    errors, in the axes of pose 0, to that of the point, (P, 3, 3); its covariance (P, 3, 3), m^2.

    The third row measures nothing.
    """
    seen = graph.sightings
    order = np.argsort(seen.landmark, kind="stable")
    _, first, times = np.unique(seen.landmark[order], return_index=True, return_counts=True)
    a, b = order[first[times == 2]], order[first[times == 2] + 1]
    inside = np.maximum(seen.of[a], seen.of[b]) <= last
    a, b = a[inside][-MOST_PAIRS:], b[inside][-MOST_PAIRS:]
    poses = se2.between(graph.poses[:1], graph.poses[seen.of])
    at = se2.points_from(poses, seen.xy)
    x_m, y_m = (0.5 * (at[a] + at[b])).T
    rows = np.tile(np.diag([1.0, 1.0, 0.0]), (len(a), 1, 1))
    rows[:, 0, 2], rows[:, 1, 2] = -y_m, x_m
    turned = se2.adjoint(poses)[:, :2, :2]
    seen_at_origin = turned @ seen.covariance @ turned.transpose(0, 2, 1)
    covariance = np.tile(np.eye(3), (len(a), 1, 1))
    covariance[:, :2, :2] = seen_at_origin[a] + seen_at_origin[b]
    return seen.of[a], seen.of[b], rows, covariance


def _shared(along: Floats, a: np.ndarray, b: np.ndarray) -> Floats:
    """(A, B, 3, 3) covariance of the errors of poses a with those of poses b."""
    return np.asarray(along[np.minimum(a[:, None], b[None, :])])
