"""Covariance of the newest key frame in the map, by the graph and the motion model in hindsight."""

from collections.abc import Collection

import numpy as np

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.odometry_edges import (
    MIN_EDGE_COVARIANCE,
    matched_steps,
)
from service.mapper.graph.model.pose_graph import UNKNOWN_COVARIANCE, Edges, PoseGraph
from service.mapper.graph.model.pose_graph_solver import covariance_of
from service.mapper.known_pose import KnownPose

MIN_VARIANCE_SHARE = 1e-12  # of the largest variance of a step: above rounding


def edges_in_hindsight(keyframes: KeyframeList, step_m: float) -> Edges:
    """Steps between key frames, with the covariances of the motion model smoothed over the entire drive:
    along a path without loops they sum to that of the newest pose.

    A key frame is known at least as well as a later one, minus what the step between them has added; [34].
    """
    edges, is_unknown = matched_steps(keyframes, step_m)
    known = keyframes.motion_covariance.copy()
    is_known = np.isfinite(known[edges.of] + known[edges.to]).all(axis=(1, 2)) & ~is_unknown
    there = se2.adjoint(edges.measured)
    back = np.linalg.inv(there)
    for k in np.flatnonzero(is_known)[::-1].tolist():
        of, to = edges.of[k], edges.to[k]
        variances, axes = np.linalg.eigh(known[to] - back[k] @ known[of] @ back[k].T)
        added = (axes * np.maximum(variances, max(variances[-1] * MIN_VARIANCE_SHARE, 0.0))) @ axes.T
        known[of] = there[k] @ (known[to] - added) @ there[k].T
        edges.covariance[k] = added + MIN_EDGE_COVARIANCE
    edges.covariance[is_unknown] = UNKNOWN_COVARIANCE
    return edges


def known_pose(
    keyframes: KeyframeList, joined: Collection[int], graph: PoseGraph, fixed_count: int
) -> KnownPose | None:
    """The newest key frame with a known place in the map; None: there is none, or its covariance is unknown.

    joined        numbers of the segments with a known place
    graph         with edges in hindsight; its first pose stands for the first fixed_count key frames
    """
    placed = np.flatnonzero(np.isin(keyframes.segment, list(joined)))
    if not len(placed) or not np.isfinite(keyframes.motion_covariance[placed[-1]]).all():
        return None
    k = int(placed[-1])
    covariance = covariance_of(graph, k - max(fixed_count - 1, 0))
    return KnownPose(SE2(*keyframes.odom[k].tolist()), keyframes.motion_covariance[k].copy(), covariance)
