"""How well the last pose of a chain with loops is known against the first."""

import numpy as np

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.pose_graph import PoseGraph, edge_chi2

MOST_LOOPS = 100  # the newest ones; what the others say is left out, and the covariance no smaller by them
OPEN_COVARIANCE = np.diag([1e3, 1e3, 10.0])  # m^2, rad^2: of a step that nothing measures


def covariance_of_last(graph: PoseGraph, last: int) -> Floats:
    """(3, 3) of pose `last` against pose 0, in its own axes, at the poses as they are; edges alone count.

    In the axes of pose 0 the errors along a chain of steps add up, so any two of its poses share the error
    up to the earlier one. Every edge that is no step is a measurement of a difference of two such errors; all
    are taken in at once (Barfoot, State Estimation for Robotics, 2017, section 3.3). Unlike a solver's
    marginals it is well conditioned where steps are known to 0.1 mm and one of them is not known at all.
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
    known = along[last]
    if len(loops):
        of, to = edges.of[loops], edges.to[loops]
        shared = (
            _shared(along, to, to) - _shared(along, to, of) - _shared(along, of, to) + _shared(along, of, of)
        )
        shared[np.arange(len(loops)), np.arange(len(loops))] += covariance[loops]
        size = 3 * len(loops)
        with_last = (along[to] - along[of]).transpose(1, 0, 2).reshape(3, size)
        measured = shared.transpose(0, 2, 1, 3).reshape(size, size)
        known = known - with_last @ np.linalg.solve(measured, with_last.T)
    back = se2.adjoint(se2.between(graph.poses[last], graph.poses[0]))
    found = back @ known @ back.T
    return np.asarray(0.5 * (found + found.T), np.float64)


def _shared(along: Floats, a: np.ndarray, b: np.ndarray) -> Floats:
    """(A, B, 3, 3) covariance of the errors of poses a with those of poses b."""
    return np.asarray(along[np.minimum(a[:, None], b[None, :])])
