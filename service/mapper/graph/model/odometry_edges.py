"""Steps of odometry between key frames, as edges of the graph, and their covariance."""

import numpy as np
import numpy.typing as npt

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.pose_graph import Edges
from service.mapper.known_pose import covariance_added

STEP_FLOOR = np.diag([0.003**2, 0.003**2, 0.0007**2])  # m^2, rad^2: of a step between key frames, at best
# m^2, rad^2: of a step that was not matched, where no motion model says how well it is known
LOST_COVARIANCE = np.diag([1.0, 1.0, 0.5])
MAX_PREDICTION_VARIANCE = (0.09, 0.09)  # m^2, rad^2: ... added at most where an end hardly lies on the map
UNKNOWN_COVARIANCE = np.diag([1e3, 1e3, 10.0])  # ... into a piece that nobody knows the place of
# ... into a piece, where no scan was missing, so that nobody carried the vehicle; added to the motion model's
NEW_SEGMENT_COVARIANCE = np.diag([1.0, 1.0, 0.01])
MAX_SCAN_GAP_S = 2.0  # without scans: a vehicle whose wheels hung may be anywhere
MIN_EDGE_COVARIANCE = np.diag([1e-4**2, 1e-4**2, 1e-5**2])  # m^2, rad^2: of a step that nothing was added in
GAP_SHARE = 0.1  # of a way without scans: what odometry may have erred by
POOR_MATCH_SHARE = 0.6  # of the drive's median share on the map: with less the match may be wrong


def lost_steps(keyframes: KeyframeList) -> npt.NDArray[np.bool_]:
    """(N - 1,) steps between key frames of which one was not matched."""
    lost = keyframes.is_lost
    return lost[1:] | lost[:-1]


def poor_match_steps(keyframes: KeyframeList) -> npt.NDArray[np.bool_]:
    """(N - 1,) steps to or from a key frame of which far less than usual lies on the map."""
    doubtful = _are_poor_matches(keyframes)
    return doubtful[1:] | doubtful[:-1]


def _are_poor_matches(keyframes: KeyframeList) -> npt.NDArray[np.bool_]:
    score = keyframes.score
    doubtful: npt.NDArray[np.bool_] = score < POOR_MATCH_SHARE * np.median(score)
    return doubtful


def _prediction_covariance(keyframes: KeyframeList) -> Floats:
    """(N - 1, 3, 3) what is added to steps: a match in doubt is known as well as the predictions alone."""
    each = _are_poor_matches(keyframes)[:, None] * np.minimum(
        keyframes.prediction_variance, MAX_PREDICTION_VARIANCE
    )
    step = np.maximum(each[1:], each[:-1])
    return np.asarray(np.eye(3) * step[:, [0, 0, 1], None])


def odometry_edges(keyframes: KeyframeList, step_m: float, is_by_motion: bool = False) -> Edges:
    """From each key frame to the next.

    step_m         the way after which a key frame is due
    is_by_motion   a step is known as well as the motion model says, where it says so and the match is not
                   in doubt; one to or from a key frame that was not matched always is
    """
    edges, is_into_segment = matched_steps(keyframes, step_m)
    covariance, is_lost = edges.covariance, lost_steps(keyframes)
    then, now = keyframes.motion_covariance[edges.of], keyframes.motion_covariance[edges.to]
    is_by_model = np.isfinite(then + now).all(axis=(1, 2)) & (is_lost | is_into_segment | is_by_motion)
    covariance[is_by_model] = covariance_added(
        then[is_by_model], now[is_by_model], edges.measured[is_by_model]
    )
    covariance[is_by_model] += MIN_EDGE_COVARIANCE if is_by_motion else STEP_FLOOR
    # What was not matched cannot be a wrong match.
    covariance += np.where((is_by_model & is_lost)[:, None, None], 0.0, _prediction_covariance(keyframes))
    covariance[is_into_segment] += NEW_SEGMENT_COVARIANCE
    is_unmeasured = (keyframes.gap_s[1:] > MAX_SCAN_GAP_S) | np.isin(
        keyframes.segment[1:], [*keyframes.unmeasured]
    )
    covariance[is_into_segment & (is_unmeasured | ~is_by_model)] = UNKNOWN_COVARIANCE
    return edges


def matched_steps(keyframes: KeyframeList, step_m: float) -> tuple[Edges, npt.NDArray[np.bool_]]:
    """Each step known as well as its match, and (N - 1,) those that lead into another piece."""
    of, is_unknown = _before(keyframes)
    to = np.arange(1, keyframes.count, dtype=np.int64)
    covariance = keyframes.covariance[1:] + STEP_FLOOR
    covariance[lost_steps(keyframes)] = LOST_COVARIANCE
    gap_m = np.maximum(np.diff(keyframes.path_length_m) - 2.0 * step_m, 0.0)
    covariance += (GAP_SHARE * gap_m[:, None, None]) ** 2 * np.eye(3)
    measured = se2.between(keyframes.odom[of], keyframes.odom[to])
    return Edges(of, to, measured, covariance, np.zeros(len(of))), is_unknown


def _before(keyframes: KeyframeList) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """(N - 1,) the key frame before each but the first, and whether it begins another piece.

    Into another piece the scans do not know the way; back in one, the newest key frame of it goes before.
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
