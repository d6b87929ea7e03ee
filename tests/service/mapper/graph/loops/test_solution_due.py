"""When the graph is solved and the map rendered: laps of a round with a small drift each."""

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.se2 import SE2
from service.mapper.graph.loops.loop_set import LEVER_M, RENDER_AT_M, SOLVE_EVERY_M, SolutionDue
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.model.loops import FLOOR, Loop
from tests.service.mapper.graph.key_frames import append_blank, key_frame

LAP, STEP_M = 40, 1.0
COUNT = round(1.5 * SOLVE_EVERY_M / STEP_M)


def laps() -> KeyframeList:
    keyframes, pose = KeyframeList(), np.zeros(3)
    for k in range(COUNT):
        pose = se2.compose(pose, np.array([STEP_M, 0.0, 2.0 * np.pi / LAP])) if k else pose
        append_blank(keyframes, key_frame(k, SE2(*pose.tolist())))
    return keyframes


def loop(to: int, off_m: float) -> Loop:
    """To the lap before, with a residual of so much."""
    return Loop(to - LAP, to, np.array([0.0, off_m, 0.0]), FLOOR, 0.9)


@pytest.mark.parametrize(("off_m", "is_news"), [(0.04, False), (0.06, True)])
def test_one_loop_makes_a_solution_due_if_it_moves_the_map_visibly(off_m: float, is_news: bool) -> None:
    due = SolutionDue(LoopsConfig(), (COUNT - 20) * STEP_M)
    assert due.is_due(laps(), [loop(COUNT - 1, off_m)]) is is_news
    assert not due.is_due(laps(), [loop(COUNT - 40, off_m)])  # of long ago


def test_loops_that_agree_make_a_solution_due_after_some_distance() -> None:
    keyframes, agreeing = laps(), [loop(COUNT - 1, 0.001)]
    assert SolutionDue(LoopsConfig(), 0.0).is_due(keyframes, agreeing)
    due = SolutionDue(LoopsConfig(), 0.0)
    due.solved(0.6 * SOLVE_EVERY_M, keyframes.map, keyframes.map)
    assert not due.is_due(keyframes, agreeing)


@pytest.mark.parametrize("moved", [(0.6 * RENDER_AT_M, 0.0, 0.0), (0.0, 0.0, -0.6 * RENDER_AT_M / LEVER_M)])
def test_the_map_is_rendered_once_it_has_moved_visibly(moved: tuple[float, float, float]) -> None:
    before = laps().map.copy()
    after = before + np.array(moved)
    due = SolutionDue(LoopsConfig(), 0.0)
    assert not due.take_rendering()
    due.solved(100.0, before, after)
    assert not due.take_rendering()
    due.solved(200.0, before, after)
    assert due.take_rendering()
    assert not due.take_rendering()
    due.require_rendering()
    assert due.take_rendering()
