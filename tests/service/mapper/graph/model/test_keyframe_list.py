from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from tests.service.mapper.graph.key_frames import append, key_frame, polygon

WALLS = polygon((-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0))


def kept_of(poses: list[SE2]) -> list[int]:
    """Key frames of a detached segment that keep their points."""
    keyframes, noise = KeyframeList(), np.random.default_rng(1)
    for pose in poses:
        append(keyframes, WALLS, pose, 1, noise)
        keyframes.forget_stationary(3, LoopsConfig())
    return np.flatnonzero(keyframes.has_points).tolist()


def test_at_creep_or_turning_one_key_frame_of_each_step_keeps_its_points():
    assert kept_of([SE2(0.11 * k, 0.0, 0.0) for k in range(16)]) == [0, 3, 6, 9, 12, 13, 14, 15]
    assert kept_of([SE2(0.0, 0.0, 0.08 * k) for k in range(9)]) == [0, 2, 4, 6, 7, 8]


def test_a_key_frame_back_in_a_segment_is_placed_by_its_newest_one():
    """Odometry jumps where a map that began apart is left for the one before."""
    keyframes, noise = KeyframeList(), np.random.default_rng(1)
    append(keyframes, WALLS, SE2(1.0, 0.0, 0.0), 0, noise)
    append(keyframes, WALLS, SE2(2.0, 1.0, 0.5), 1, noise)
    keyframes.map[:] = (1.0, 0.2, 0.0), (2.0, 0.0, 0.0)
    newest = keyframes.newest_by_segment()
    assert list(newest) == [1, 0]  # the first is the newest of all
    assert newest[0].pose_map_base == SE2(1.0, 0.2, 0.0)

    back = key_frame(1, SE2(3.0, 0.0, 0.0))
    assert keyframes.place_of(back) == pytest.approx([3.0, 0.2, 0.0])
    assert keyframes.place_of(replace(back, segment=2)) == pytest.approx([2.398, -1.357, -0.5], abs=1e-3)
