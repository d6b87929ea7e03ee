import numpy as np

from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList
from service.mapper.graph.model.loops_config import LoopsConfig
from tests.service.mapper.graph.relocalise.test_known_map import append

WALLS = [(-3.0, -3.0, 3.0, -3.0), (3.0, -3.0, 3.0, 3.0), (3.0, 3.0, -3.0, 3.0), (-3.0, 3.0, -3.0, -3.0)]


def kept_of(poses: list[SE2]) -> list[int]:
    """Which key frames of a piece that is looked for keep their points."""
    keyframes, noise = KeyframeList(), np.random.default_rng(1)
    for pose in poses:
        append(keyframes, WALLS, pose, 1, noise)
        keyframes.forget_one_standing(3, LoopsConfig())
    return np.flatnonzero(keyframes.has_points).tolist()


def test_of_one_spot_the_first_and_the_newest_keep_their_points():
    assert kept_of([SE2(0.001 * (k % 3), 0.0, 0.0) for k in range(20)]) == [0, 17, 18, 19]


def test_of_a_vehicle_that_creeps_or_turns_one_of_each_step_keeps_its_points():
    assert kept_of([SE2(0.11 * k, 0.0, 0.0) for k in range(16)]) == [0, 3, 6, 9, 12, 13, 14, 15]
    assert kept_of([SE2(0.0, 0.0, 0.08 * k) for k in range(9)]) == [0, 2, 4, 6, 7, 8]
