"""Changes by hand in a back end that is at work: a ring of corridors, driven one and a half times."""

import json
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.mapper.components import EditAnswer
from service.mapper.edit_requests import EDIT_MAP
from service.mapper.graph.edit.editing import without_loops
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd, Result
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.saved_graph import SavedGraph
from tests.service.mapper.graph.loops.rings import RENDERER, ROUND, fed_ring, ring, seam_m

FRAMES, TRUTH = ring()
SPOTS = (8, 30, 52)  # key frames of the first round


@pytest.fixture
def open_ring() -> LoopBackEnd:
    """Without accepted loops: the second round is offset from the first."""
    return pickle.loads(fed_ring(is_open=True)[0])


@pytest.fixture
def closed_ring() -> LoopBackEnd:
    return pickle.loads(fed_ring()[0])


def edited(back_end: LoopBackEnd, **change: Any) -> tuple[Result, EditAnswer]:
    result = back_end.work(
        Batch([], "edit_map", change=EDIT_MAP.validate_json(json.dumps({"change": change})).change)
    )
    assert result.edited is not None
    return result, result.edited


def saved(back_end: LoopBackEnd) -> SavedGraph:
    graph = back_end.work(Batch([], "checkpoint")).saved
    assert isinstance(graph, SavedGraph)
    return graph.checked()


def pairs_of_both_rounds(graph: SavedGraph, off_m: float = 0.0) -> list[dict[str, Any]]:
    """A point of the wall that both saw, off_m beside it in the second round."""
    pairs = []
    for k in SPOTS:
        wall = graph.xy_base[graph.point_count[:k].sum()].astype(np.float64)
        true_map = TRUTH[k] @ type(TRUTH[k])(float(wall[0]), float(wall[1]), 0.0)
        later = TRUTH[k + ROUND].inverse() @ true_map
        stamps = (str(FRAMES[k].stamp_ns), str(FRAMES[k + ROUND].stamp_ns))
        points = (tuple(wall.tolist()), (later.x_m + off_m, later.y_m))
        pairs.append({"stamps_ns": stamps, "points_base": points})
    return pairs


def test_pairs_close_a_ring_that_no_loop_has_closed_and_list_what_is_left_of_each(open_ring: LoopBackEnd):
    before = saved(back_end := open_ring)
    assert seam_m(before.map, TRUTH).min() > 0.5
    result, answer = edited(back_end, what="add-pair", pairs=pairs_of_both_rounds(before))
    assert answer.reply["done"].startswith("pairs 0 to 2; key frames moved by up to ")
    assert [pair["apart_mm"] < 50.0 for pair in answer.reply["pairs"]] == [True] * 3
    assert answer.reply["moved_m"] > 0.5
    assert result.newest
    assert result.rendered_map is not None
    assert seam_m(saved(back_end).map, TRUTH).max() < 0.1
    _, answer = edited(back_end, what="remove-pair", pair=1)
    assert len(answer.reply["pairs"]) == 2
    at_s = SPOTS[0] / 10.0
    _, answer = edited(back_end, what="cut", from_s=at_s - 0.05, to_s=at_s + 0.05, bridge=True)
    assert len(answer.reply["pairs"]) == 1
    for count in (2, 3, 0):
        _, answer = edited(back_end, what="undo")
        assert len(answer.reply["pairs"]) == count
    np.testing.assert_allclose(saved(back_end).map, before.map, atol=2e-3)
    assert "left to take back" in edited(back_end, what="undo")[1].error


@pytest.mark.parametrize("is_bridged", [False, True])
def test_a_cut_removes_points_and_loops_of_its_time_and_undo_restores_them(
    closed_ring: LoopBackEnd, is_bridged: bool
):
    before = saved(back_end := closed_ring)
    ends = before.loop_ends.tolist()
    assert ends
    span = {"what": "cut", "from_s": ends[0][1] / 10.0 - 0.25, "to_s": ends[0][1] / 10.0 + 0.25}
    is_cut = np.abs(np.arange(len(before)) - ends[0][1]) <= 2
    touched = int(is_cut[np.array(ends)].any(axis=1).sum())
    _, answer = edited(back_end, **span, bridge=is_bridged)
    gone = f"{touched} loop{'s' * (touched > 1)}"
    assert answer.reply["done"].startswith(f"cut {is_cut.sum()} key frames out, and {gone} with them")
    less = saved(back_end)
    np.testing.assert_array_equal(less.point_count == 0, is_cut)
    assert len(less.loop_ends) == len(ends) - touched
    edited(back_end, what="undo")
    again = saved(back_end)
    np.testing.assert_array_equal(again.point_count, before.point_count)
    np.testing.assert_array_equal(again.is_lost, before.is_lost)
    assert sorted(again.loop_ends.tolist()) == sorted(ends)
    np.testing.assert_allclose(again.map, before.map, atol=2e-3)


def shown(back_end: LoopBackEnd, kind: str) -> list[dict[str, Any]]:
    """What the page gets of accepted or refused loops."""
    picture = back_end.work(Batch([], "checkpoint")).picture
    assert picture is not None
    return [*map(dict, picture.evidence[kind])]


def test_a_loop_is_refused_and_undo_restores_it(closed_ring: LoopBackEnd):
    before = saved(back_end := closed_ring)
    worst = shown(back_end, "accepted")[0]
    assert worst["off_mm"] == max(loop["off_mm"] for loop in shown(back_end, "accepted"))
    assert 0.0 < worst["sigma_mm"] < 500.0
    assert worst["way_m"] > 10.0
    change = {"what": "refuse-loop", "stamps_ns": worst["stamps_ns"]}
    result, answer = edited(back_end, **change)
    assert answer.reply["done"].startswith("took back the loop from key frame ")
    assert result.rendered_map is not None
    (found,) = [loop for loop in shown(back_end, "refused") if loop["stamps_ns"] == worst["stamps_ns"]]
    assert found["why"] == "refused by the operator"
    assert "no accepted loop joins" in edited(back_end, **change)[1].error
    assert len(saved(back_end).loop_ends) == len(before.loop_ends) - 1
    edited(back_end, what="undo")
    assert sorted(saved(back_end).loop_ends.tolist()) == sorted(before.loop_ends.tolist())
    assert worst["stamps_ns"] not in [loop["stamps_ns"] for loop in shown(back_end, "refused")]


def test_the_only_loop_that_joins_a_segment_is_not_refused(closed_ring: LoopBackEnd):
    graph = saved(closed_ring)
    graph = without_loops(graph, range(2, len(graph.loop_ends)))
    later = (np.arange(len(graph)) >= graph.loop_ends[:, 1].min()).astype(np.int64)
    back_end = LoopBackEnd(LoopsConfig(), RENDERER, replace(graph, segment=later))
    first, second = shown(back_end, "accepted")
    assert not edited(back_end, what="refuse-loop", stamps_ns=first["stamps_ns"])[1].error
    _, answer = edited(back_end, what="refuse-loop", stamps_ns=second["stamps_ns"])
    assert "join it by a pair of points first" in answer.error
    assert [loop["stamps_ns"] for loop in shown(back_end, "accepted")] == [second["stamps_ns"]]


def pair_of(*stamps_ns: str) -> dict[str, Any]:
    return {"stamps_ns": stamps_ns, "points_base": ((0.0, 0.0), (0.0, 0.0))}


def test_an_impossible_change_is_refused_and_changes_nothing(open_ring: LoopBackEnd):
    before = saved(back_end := open_ring)
    for change, words in (
        ({"what": "remove-pair", "pair": 0}, "there is no pair 0"),
        ({"what": "cut", "from_s": 1e6, "to_s": 1e7}, "no key frame lies in that time"),
        ({"what": "cut", "from_s": 0.0, "to_s": 1e7}, "that is all of the map"),
        ({"what": "add-pair", "pairs": [pair_of("0", "7")]}, "the key frame of 7 ns is not in the map"),
        ({"what": "add-pair", "pairs": [pair_of("0", "0")]}, "of one key frame"),
    ):
        result, answer = edited(back_end, **change)
        assert words in answer.error
        assert result.rendered_map is None
    after = saved(back_end)
    np.testing.assert_array_equal(after.map, before.map)
    np.testing.assert_array_equal(after.point_count, before.point_count)
