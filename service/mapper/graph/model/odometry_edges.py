"""Odometry steps between key frames as edges of the graph, and the newest pose by them in hindsight."""

import numpy as np
import numpy.typing as npt

from service.estimator.estimator import MIN_SIGMA
from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.pose_graph import UNKNOWN_COVARIANCE, Edges, PoseGraph
from service.mapper.graph.model.pose_graph_solver import covariance_of
from service.mapper.judgement import GAP_S
from service.mapper.known_pose import KnownPose, covariance_added

STEP_FLOOR = np.diag([0.003**2, 0.003**2, 0.0007**2])  # m^2, rad^2: least covariance of a step
# m^2, rad^2: of an unmatched step without a motion model
LOST_COVARIANCE = np.diag([1.0, 1.0, 0.5])
# m^2, rad^2: added to the motion model's into a segment without a scan gap: the vehicle was not carried
NEW_SEGMENT_COVARIANCE = np.diag([1.0, 1.0, 0.01])
MIN_EDGE_COVARIANCE = np.diag(np.square(MIN_SIGMA))  # of a step without added noise
GAP_SHARE = 0.1  # of a path without key frames, as where old passes were removed: error of odometry
MIN_VARIANCE_SHARE = 1e-12  # of the largest variance of a step: above rounding


def lost_steps(keyframes: KeyframeList) -> npt.NDArray[np.bool_]:
    """(N - 1,) steps with an unmatched key frame at one end."""
    lost = keyframes.is_lost
    return lost[1:] | lost[:-1]


def odometry_edges(keyframes: KeyframeList, step_m: float, is_by_motion: bool = False) -> Edges:
    """Edges from each key frame to the next.

    step_m         path length after which a key frame is due
    is_by_motion   use the covariance of the motion model for all steps where it is known; for unmatched
                   steps it is always used
    """
    edges, is_into_segment = matched_steps(keyframes, step_m)
    covariance = edges.covariance
    then, now = keyframes.motion_covariance[edges.of], keyframes.motion_covariance[edges.to]
    is_by_model = np.isfinite(then + now).all(axis=(1, 2)) & (
        lost_steps(keyframes) | is_into_segment | is_by_motion
    )
    covariance[is_by_model] = covariance_added(
        then[is_by_model], now[is_by_model], edges.measured[is_by_model]
    )
    covariance[is_by_model] += MIN_EDGE_COVARIANCE if is_by_motion else STEP_FLOOR
    covariance[is_into_segment] += NEW_SEGMENT_COVARIANCE
    is_unmeasured = (keyframes.gap_s[1:] > GAP_S) | np.isin(keyframes.segment[1:], [*keyframes.unmeasured])
    covariance[is_into_segment & (is_unmeasured | ~is_by_model)] = UNKNOWN_COVARIANCE
    return edges


def matched_steps(keyframes: KeyframeList, step_m: float) -> tuple[Edges, npt.NDArray[np.bool_]]:
    """Steps with the covariance of their match, and (N - 1,) those that lead into another segment."""
    of, is_unknown = _before(keyframes)
    to = np.arange(1, keyframes.count, dtype=np.int64)
    covariance = keyframes.covariance[1:] + STEP_FLOOR
    covariance[lost_steps(keyframes)] = LOST_COVARIANCE
    path_m = np.diff(keyframes.path_length_m)
    # In a thinned log scans are farther apart than step_m.
    usual_m = max(step_m, float(np.median(path_m)) if len(path_m) else 0.0)
    gap_m = np.maximum(path_m - 2.0 * usual_m, 0.0)
    covariance += (GAP_SHARE * gap_m[:, None, None]) ** 2 * np.eye(3)
    measured = se2.between(keyframes.odom[of], keyframes.odom[to])
    return Edges(of, to, measured, covariance, np.zeros(len(of))), is_unknown


def _before(keyframes: KeyframeList) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """(N - 1,) the key frame before each but the first, and whether the step begins a segment.

    A step into a new segment is unknown to the scans; back in an earlier one, it starts at its newest key
    frame.
    """
    of = np.arange(keyframes.count - 1, dtype=np.int64)
    is_unknown = np.zeros(keyframes.count - 1, np.bool_)
    segments = keyframes.segment
    last_of: dict[int, int] = {}
    for k in (np.flatnonzero(np.diff(segments)) + 1).tolist():
        before, segment = int(segments[k - 1]), int(segments[k])
        last_of[before] = k - 1
        of[k - 1] = last_of.get(segment, k - 1)
        is_unknown[k - 1] = segment not in last_of
    return of, is_unknown


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
    keyframes: KeyframeList, is_known: npt.NDArray[np.bool_], graph: PoseGraph, fixed_count: int
) -> KnownPose | None:
    """The newest key frame with a known place in the map; None: there is none, or its covariance is unknown.

    is_known      (N,) key frames with a known place
    graph         with edges in hindsight; its first pose stands for the first fixed_count key frames
    """
    placed = np.flatnonzero(is_known)
    if not len(placed) or not np.isfinite(keyframes.motion_covariance[placed[-1]]).all():
        return None
    k = int(placed[-1])
    covariance = covariance_of(graph, k - max(fixed_count - 1, 0))
    return KnownPose(SE2(*keyframes.odom[k].tolist()), keyframes.motion_covariance[k].copy(), covariance)
