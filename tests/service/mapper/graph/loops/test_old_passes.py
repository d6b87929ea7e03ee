"""Eleven passes along one straight line; key frames and loops are made by hand."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.loops import old_passes
from service.mapper.graph.loops.old_passes import OldPasses
from service.mapper.graph.model.keyframe_list import KeyFrame, KeyframeList, LoopsConfig, ThinnedScan
from service.mapper.graph.model.loops import Loop

PASSES, LONG = 11, 60  # key frames a pass: the newest 30 m, from pass 9 on, are not looked at


@pytest.mark.parametrize(
    ("leads_to", "without_points", "removed"),
    [
        (lambda number: 0, [1, 2, 3], [1, 2, 3]),
        (lambda number: number - 1, [1, 2, 3], []),  # each alone joins the next one to the first
        (lambda number: number - 1 if number < 9 else 0, [1, 2, 3], [1, 2, 3]),  # joined in the end
    ],
)
def test_the_first_and_the_newest_passes_stay_and_those_between_once_a_loop_joins_them(
    leads_to: Callable[[int], int],
    without_points: list[int],
    removed: list[int],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(old_passes, "MIN_REMOVED_AT_ONCE", 10)
    keyframes, loops = driven(leads_to)
    passes = OldPasses(LoopsConfig(keep_passes=6), keyframes)
    passes.forget(loops)
    assert set((np.flatnonzero(~keyframes.has_points) // LONG).tolist()) == set(without_points)
    assert passes.renumbering([np.arange(PASSES * LONG)]) is None  # all are needed
    new = passes.renumbering([[LONG + 5]])  # holds a fix
    assert (new is not None) == bool(removed)
    if new is not None:
        gone = np.flatnonzero(~new.is_kept)
        assert set((gone // LONG).tolist()) == set(removed)
        assert LONG + 5 not in gone
        keyframes.keep(new.is_kept)
        assert passes.removed_count == len(gone) == PASSES * LONG - keyframes.count
        assert [one.stamp_ns for one in passes.corrections()] == list(range(PASSES * LONG))


def driven(leads_to: Callable[[int], int]) -> tuple[KeyframeList, Sequence[Loop]]:
    """leads_to: the earlier pass that the loops of a pass lead to."""
    keyframes = KeyframeList()
    points = ThinnedScan(np.ones((3, 2), np.float32), np.ones((3, 3), np.float32), (0.0, 0.0))
    for k in range(PASSES * LONG):
        pose = SE2(0.3 * (k % LONG), 0.01 * (k // LONG), 0.0)
        frame = KeyFrame(k, pose, np.eye(3) * 1e-4, 0, 0.9, False, points.xy_base, (0.0, 0.0), 0.01)
        keyframes.append(frame, np.array([pose.x_m, pose.y_m, 0.0]), points)
    loops = [
        Loop(leads_to(number) * LONG + at, number * LONG + at, np.zeros(3), np.eye(3), 0.9)
        for number in range(1, PASSES)
        for at in range(0, LONG, 7)
    ]
    return keyframes, loops
