"""Loops in a ring of corridors: found, accepted by consensus or odometry, disabled when wrong."""

import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.components import Correction
from service.mapper.graph.loops import old_passes
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd, Result
from service.mapper.graph.model.graph_picture import PICTURE_GAP_M
from service.mapper.graph.model.keyframe_list import KeyFrame, LoopsConfig
from service.mapper.graph.model.loops import Loop
from tests.service.mapper.graph.loops import rings
from tests.service.mapper.graph.loops.rings import LENGTH_M, ROUND, STEP_M, key_frames, ring

BATCH = 7
FRAMES, TRUTH = ring()


def fed(frames: list[KeyFrame], config: LoopsConfig | None = None) -> LoopBackEnd:
    back_end = LoopBackEnd(config or LoopsConfig(), None)
    for k in range(0, len(frames), BATCH):
        back_end.work(Batch(frames[k : k + BATCH]))
    return back_end


def loaded() -> tuple[LoopBackEnd, list[Result]]:
    """A copy of the back end that all of the ring was given to, and its results."""
    back_end, results = rings.fed_ring()
    return pickle.loads(back_end), results


def errors_m(corrections: Sequence[Correction], truth: list[SE2]) -> np.ndarray:
    away = [true.inverse() @ c.pose_map_base for true, c in zip(truth, corrections, strict=True)]
    return np.array([np.hypot(e.x_m, e.y_m) for e in away])


def seam_m(corrections: Sequence[Correction], truth: list[SE2]) -> np.ndarray:
    return rings.seam_m(np.array([c.pose_map_base for c in corrections]), truth)


def test_a_ring_is_closed_and_the_path_corrected():
    back_end, results = loaded()
    drifted = [Correction(f.stamp_ns, f.pose_odom_base, f.pose_odom_base) for f in FRAMES]
    assert seam_m(drifted, TRUTH).min() > 0.5
    assert results[len(FRAMES) // (2 * BATCH)].loops == 0
    corrected_live = next(r for r in results if r.newest)
    assert corrected_live.loops >= 3
    assert corrected_live.rendered_map is not None
    finished = back_end.work(Batch([], is_last=True))
    assert seam_m(finished.all, TRUTH).max() < 0.02
    assert np.median(errors_m(finished.all, TRUTH)) < 0.3 * np.median(errors_m(drifted, TRUTH))
    assert finished.disabled == 0
    assert finished.g2o.count("VERTEX_SE2") == len(FRAMES)
    assert finished.g2o.count("EDGE_SE2") >= len(FRAMES) - 1 + finished.loops


def test_memory_and_graph_grow_with_the_area_and_not_with_the_path(monkeypatch: pytest.MonkeyPatch):
    """The first pass and the newest ones stay, and the path of all scans is as good as that."""
    monkeypatch.setattr(old_passes, "MIN_REMOVED_AT_ONCE", 40)
    frames, truth = key_frames(3.3)
    back_end = LoopBackEnd(LoopsConfig(keep_passes=1), None)
    results = [back_end.work(Batch(frames[k : k + BATCH])) for k in range(0, len(frames), BATCH)]
    keyframes, a_round = back_end.keyframes, ROUND
    assert keyframes.count < 3.0 * a_round
    assert keyframes.has_points.sum() < 2.7 * a_round
    stamps_ns = [frame.stamp_ns for frame in frames]
    assert set(stamps_ns[: a_round - 20] + stamps_ns[-a_round:]) <= set(keyframes.stamps_ns)
    assert (np.diff([result.loops for result in results]) >= 0).all()  # including removed ones
    finished = back_end.work(Batch([], is_last=True))
    assert [correction.stamp_ns for correction in finished.all] == stamps_ns
    assert seam_m(finished.all, truth).max() < 0.02
    assert finished.picture is not None
    longest_m = max(np.hypot(*np.diff(path, axis=0).T).max(initial=0.0) for path in finished.picture.paths)
    assert longest_m < PICTURE_GAP_M


def test_localisation_drops_nothing_of_the_stored_map():
    """However often a spot is passed: passes of the session go, and then nothing would be known there."""
    stored = loaded()[0].work(Batch([], is_last=True)).saved
    assert stored is not None
    back_end = LoopBackEnd(LoopsConfig(keep_passes=2), None, stored, is_localizing=True)
    frames, _ = key_frames(2.2, seed=1)
    session = [replace(frame, segment=0) for frame in frames]
    results = [back_end.work(Batch(session[k : k + BATCH])) for k in range(0, len(session), BATCH)]
    keyframes = back_end.keyframes
    assert results[-1].place.placed == "proven"
    assert keyframes.has_points[: len(stored)].all()


@pytest.mark.parametrize("is_known", [True, False], ids=["known", "unknown"])
def test_a_lap_that_ends_where_it_began_is_closed_where_the_path_is_known(is_known: bool):
    """What the last metres see again is one spot: there is no company."""
    frames, truth = key_frames(1.0, turn_error_radpm=2e-4)
    known = [
        replace(frame, motion_covariance=k * np.diag([1e-4, 1e-4, 6e-7]) if is_known else None)
        for k, frame in enumerate(frames)
    ]
    finished = fed(known).work(Batch([], is_last=True))
    end_m = errors_m(finished.all, truth)[-1]
    assert bool(finished.loops) is is_known
    assert bool(end_m < 0.03) is is_known, end_m


def test_a_contradicted_false_loop_is_disabled():
    back_end, _ = loaded()
    false = Loop(10, 80, np.array([0.0, 0.3, 0.0]), np.diag([1e-4, 1e-4, 1e-5]), 0.9)
    back_end.loops.accepted.append(false)
    finished = back_end.work(Batch([], is_last=True))
    assert finished.disabled >= 1
    assert false not in back_end.loops.accepted
    assert seam_m(finished.all, TRUTH).max() < 0.02


def test_undo_restores_the_path_before_the_newest_loops():
    back_end, results = loaded()
    before = results[-1].loops
    undone = [back_end.work(Batch([], "undo")) for _ in range(before)]
    *_, result = (one for one in undone if one.newest)
    assert before > result.loops == undone[-1].loops == 0
    (newest,) = result.newest.values()
    assert newest.pose_map_base.x_m == pytest.approx(newest.pose_odom_base.x_m, abs=1e-3)


def moved(frame: KeyFrame, by: SE2, segment: int, later_ns: int) -> KeyFrame:
    """The same key frame, in the odom of a segment that began elsewhere."""
    return replace(
        frame, stamp_ns=frame.stamp_ns + later_ns, pose_odom_base=by @ frame.pose_odom_base, segment=segment
    )


ELSEWHERE = SE2(30.0, -20.0, 1.0)
SIDE = round(LENGTH_M / STEP_M)  # key frames along the first side


def segment_after(known: list[KeyFrame], frames: list[KeyFrame]) -> list[KeyFrame]:
    """The frames as a segment with another odom."""
    later_ns = known[-1].stamp_ns + 10**8
    return [moved(frame, ELSEWHERE, 1, later_ns) for frame in frames]


def test_a_segment_found_twice_four_metres_apart_is_joined():
    known = FRAMES[:SIDE]
    again = segment_after(known, known[5:-5])
    back_end = LoopBackEnd(LoopsConfig(), None)
    back_end.work(Batch(known))
    joined_at = []
    for k in range(0, len(again), 4):
        result = back_end.work(Batch(again[k : k + 4]))
        if result.joined:
            joined_at.append(k)
            assert result.joined == 1
            assert result.newest
    assert len(joined_at) == 1  # and not again
    assert (joined_at[0] + 4) * STEP_M >= 4.0
    finished = back_end.work(Batch([], is_last=True))
    assert [k for k, one in enumerate(finished.all) if one.begins_segment] == [SIDE]
    for first, second in zip(finished.all[5:], finished.all[SIDE:], strict=False):
        away = first.pose_map_base.inverse() @ second.pose_map_base
        assert np.hypot(away.x_m, away.y_m) < 0.05
        assert abs(away.theta_rad) < 0.01


def test_a_segment_seen_from_one_place_only_is_not_joined():
    """From one viewpoint a room looks like any other of its kind."""
    known = FRAMES[:SIDE]
    back_end = LoopBackEnd(LoopsConfig(), None)
    back_end.work(Batch(known))
    for k, frame in enumerate(segment_after(known, known[10:11] * 6)):
        assert not back_end.work(Batch([replace(frame, stamp_ns=frame.stamp_ns + k)])).joined
