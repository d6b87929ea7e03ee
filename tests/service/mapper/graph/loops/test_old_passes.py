"""Nine passes along one straight line, key frames and loops made by hand."""

from collections.abc import Callable

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.loops import old_passes
from service.mapper.graph.loops.old_passes import OldPasses
from service.mapper.graph.model.keyframe_list import KeyFrame, KeyframeList, ThinnedScan
from service.mapper.graph.model.loops import Loop
from service.mapper.graph.model.loops_config import LoopsConfig

PASSES, LONG = 9, 60  # key frames a pass


@pytest.fixture(autouse=True)
def taken_out_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(old_passes, "MIN_REMOVED_AT_ONCE", 10)


def driven(leads_to: Callable[[int], int]) -> tuple[KeyframeList, list[Loop]]:
    """leads_to: the earlier pass that the loops of a pass lead to."""
    keyframes = KeyframeList()
    points = ThinnedScan(np.ones((3, 2), np.float32), np.ones((3, 3), np.float32), (0.0, 0.0))
    for k in range(PASSES * LONG):
        # Each pass but the first is closer to the next one than to the first.
        aside_m = 0.01 * (k // LONG) if k >= LONG else -0.1
        pose = SE2(0.3 * (k % LONG), aside_m, 0.0)
        frame = KeyFrame(k, pose, np.eye(3) * 1e-4, 0, 0.9, False, points.xy_base, (0.0, 0.0), 0.01)
        keyframes.append(frame, np.array([pose.x_m, pose.y_m, 0.0]), points)
    loops = [
        Loop(leads_to(number) * LONG + at, number * LONG + at, np.zeros(3), np.eye(3), 0.9)
        for number in range(1, PASSES)
        for at in range(0, LONG, 7)
    ]
    return keyframes, loops


def test_passes_between_the_first_and_the_newest_are_removed():
    keyframes, loops = driven(lambda number: 0)
    passes = OldPasses(LoopsConfig(keep_passes=6), keyframes)
    passes.forget(loops)
    fixed = LONG + 5
    new = passes.renumbering([[fixed], np.zeros((0, 2), np.int64)])
    assert new is not None
    gone = np.setdiff1d(np.arange(LONG, 2 * LONG), [fixed])  # of the seven that pass 7 had before it
    np.testing.assert_array_equal(np.flatnonzero(~new.is_kept), gone)
    left, same = new.loops(loops), new.loops(loops[-1:])
    assert same[0] is left[-1]
    keyframes.keep(new.is_kept)
    assert keyframes.count == len(new.is_kept) - len(gone) == len(keyframes.thinned)
    assert [keyframes.stamps_ns[loop.to] for loop in left] == [one.to for one in loops if one.to not in gone]
    assert passes.removed_count == len(gone)
    passes.forget(left)
    assert passes.renumbering([]) is None  # no key frame is checked twice


def test_removed_key_frames_move_with_the_map_beside_them():
    """Also if their reference is removed later."""
    keyframes, loops = driven(lambda number: 0)
    passes = OldPasses(LoopsConfig(keep_passes=6), keyframes)
    before = keyframes.map.copy()
    for keep in (6, 5):
        passes = passes if keep == 6 else again(passes, keep)
        passes.forget(loops)
        new = passes.renumbering([])
        assert new is not None
        loops = new.loops(loops)
        keyframes.keep(new.is_kept)
    moved = SE2(3.0, -2.0, 0.7)
    for pose in keyframes.map:
        at = moved @ SE2(*pose.tolist())
        pose[:] = at.x_m, at.y_m, at.theta_rad
    corrections = passes.corrections()
    assert [one.stamp_ns for one in corrections] == list(range(PASSES * LONG))
    for one, pose in zip(corrections, before, strict=True):
        away = one.pose_map_base.inverse() @ moved @ SE2(*pose.tolist())
        assert away.log() == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
        assert one.pose_odom_base == SE2(*pose.tolist())


def again(passes: OldPasses, keep: int) -> OldPasses:
    """Check all key frames again, with fewer passes to be kept."""
    passes._config, passes._checked_count = LoopsConfig(keep_passes=keep), 0
    return passes


def test_an_old_pass_without_loops_only_loses_its_points():
    """It alone ties the next ones: without it the map would depend on odometry."""
    keyframes, loops = driven(lambda number: number - 1)
    passes = OldPasses(LoopsConfig(keep_passes=6), keyframes)
    passes.forget(loops)
    np.testing.assert_array_equal(np.flatnonzero(~keyframes.has_points), np.arange(2 * LONG))
    assert passes.renumbering([]) is None
