"""Covariance of the newest key frame of a curved drive, by the motion model's covariances along it."""

from collections.abc import Sequence

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.odometry_edges import edges_in_hindsight, known_pose
from service.mapper.graph.model.pose_graph import Edges, PoseGraph
from service.mapper.known_pose import KnownPose, carried
from tests.service.mapper.graph.key_frames import append_blank, key_frame

STEP_M, COUNT = 0.25, 21
STEP = np.array([STEP_M, 0.0, 0.02])
BY_STEP = np.diag([4e-6, 1e-6, 1e-7])
WIDE = np.diag([0.04, 0.09, 0.01])  # of a while in which nothing was matched


def driven(
    wide: Sequence[int] = (), doubtful: Sequence[int] = (), segment: Sequence[int] = (), is_known: bool = True
) -> KeyframeList:
    keyframes, pose, by_motion = KeyframeList(), np.zeros(3), np.zeros((3, 3))
    for k in range(COUNT):
        if k:
            pose, by_motion = se2.compose(pose, STEP), carried(by_motion, STEP) + BY_STEP
        frame = key_frame(
            k,
            SE2(*pose.tolist()),
            covariance=np.diag([1e-4, 1e-4, 1e-6]),
            segment=int(k in segment),
            score=0.4 if k in doubtful else 0.9,
            is_lost=k in wide,
            motion_covariance=by_motion + (k in wide) * WIDE if is_known else None,
        )
        append_blank(keyframes, frame)
    return keyframes


def graph_of(keyframes: KeyframeList, loop: tuple[int, int] | None = None) -> PoseGraph:
    edges, poses = edges_in_hindsight(keyframes, STEP_M), keyframes.map.copy()
    if loop is not None:
        of, to = np.array([loop[0]]), np.array([loop[1]])
        measured, tight = se2.between(poses[of], poses[to]), np.diag([3e-5, 3e-5, 2e-6])[None]
        edges = edges.followed_by(Edges(of, to, measured, tight, np.full(1, 2.0)))
    return PoseGraph(poses, edges)


def known(keyframes: KeyframeList, loop: tuple[int, int] | None = None) -> KnownPose:
    found = known_pose(keyframes, keyframes.segment == 0, graph_of(keyframes, loop), 0)
    assert found is not None
    return found


def sigmas_mm(covariance: Floats) -> Floats:
    return np.asarray(1e3 * np.sqrt(covariance.diagonal()))


@pytest.mark.parametrize(
    "odd",
    [{}, {"wide": (7, 8)}, {"wide": (4, 9, 14)}, {"doubtful": (5, 6, 11)}, {"wide": (7,), "doubtful": (7,)}],
    ids=str,
)
def test_without_a_loop_the_covariance_is_that_of_the_motion_model(odd: dict[str, Sequence[int]]) -> None:
    """Whatever happened along the path: the motion model includes it."""
    found = known(driven(**odd))
    np.testing.assert_allclose(
        sigmas_mm(found.covariance), sigmas_mm(found.motion_covariance), rtol=0.01, atol=0.5
    )


def test_in_a_detached_segment_the_newest_placed_key_frame_counts() -> None:
    """What odometry measured since comes on top of it."""
    keyframes = driven(segment=range(15, COUNT))
    found = known(keyframes)
    assert found.pose_odom_base == SE2(*keyframes.odom[14].tolist())
    np.testing.assert_array_equal(found.motion_covariance, keyframes.motion_covariance[14])
    assert sigmas_mm(found.covariance).max() < 20.0
    both = known_pose(keyframes, np.ones(COUNT, np.bool_), graph_of(keyframes), 0)
    assert both is not None
    assert both.covariance[0, 0] > 100.0
