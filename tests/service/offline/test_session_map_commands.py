"""The map of a running session, as it was looked at, and changed in a later copy."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest

from service.errors import InputError
from service.geometry import poses as se2
from service.mapper.methods.corridor.graph.editing import with_pair, without_time
from service.mapstore.files import load_map
from service.offline.map_asked import AddPairs, Cut, Pair, RemovePair
from service.offline.map_log import map_log
from service.offline.session_map_commands import SessionMapCommands, moved_on
from tests.service.offline.bent_maps import ROUND, graph_in

GONE = 5  # key frames that the later graph does not have, its first
MOVED = np.array([1.0, -2.0, math.radians(10.0)])  # of the later graph against the one that was looked at
K = 6


@pytest.fixture
def later(bent):
    """As a loop has moved it since; some key frames are gone."""
    less = without_time(bent.graph, int(bent.graph.stamp_ns[0]), int(bent.graph.stamp_ns[GONE - 1]), True)
    return replace(less, map=se2.compose(MOVED, less.map))


def pair_of(points, first=K):
    return Pair(points=tuple(map(tuple, points.tolist())), keyframes=(first, first + ROUND))


def test_points_of_a_pair_go_with_the_key_frames_that_saw_them(bent, later):
    points = bent.common_points(K)[0]
    moved = moved_on(AddPairs(what="add-pair", pairs=[pair_of(points)]), bent.graph, later)
    (pair,) = moved.pairs
    assert pair.keyframes == (K - GONE, K + ROUND - GONE)
    np.testing.assert_allclose(pair.points, se2.points_from(MOVED, points), atol=1e-9)


def test_a_time_span_begins_with_the_first_key_frame_of_each(bent, later):
    gone_s = (bent.graph.stamp_ns[GONE] - bent.graph.stamp_ns[0]) / 1e9
    moved = moved_on(Cut(what="cut", from_s=3.0, to_s=4.0, bridge=True), bent.graph, later)
    assert (moved.from_s, moved.to_s) == pytest.approx((3.0 - gone_s, 4.0 - gone_s))
    assert moved.bridge


def test_a_pair_is_found_again_by_its_points(bent):
    first, second = bent.common_points(K)[:2]
    seen = with_pair(with_pair(bent.graph, first, (K, K + ROUND)), second, (K, K + ROUND))
    now = with_pair(with_pair(bent.graph, second, (K, K + ROUND)), first, (K, K + ROUND))
    assert moved_on(RemovePair(what="remove-pair", pair=0), seen, now).pair == 1
    with pytest.raises(InputError, match="no pair 0 in the map any more"):
        moved_on(RemovePair(what="remove-pair", pair=0), seen, bent.graph)


def test_what_is_of_a_key_frame_that_is_gone_is_refused(bent, later):
    asked = AddPairs(what="add-pair", pairs=[pair_of(bent.common_points(K)[0], GONE - 1)])
    with pytest.raises(InputError, match="key frame 4 is not in the map any more"):
        moved_on(asked, bent.graph, later)
    with pytest.raises(InputError, match="key frame 9999 is not"):
        moved_on(
            AddPairs(what="add-pair", pairs=[pair_of(bent.common_points(K)[0], 9999)]), bent.graph, later
        )


class Asking:
    def __init__(self):
        self._commands = SessionMapCommands()

    def ask(self, verb, folder, **request):
        line = json.dumps({"verb": verb, "map": str(folder), "request": request})
        return self._commands.answer(line.encode())


def test_a_copy_is_joined_at_places_that_were_looked_at_in_the_map_before(folder, bent, tmp_path):
    commands, copy = Asking(), tmp_path / "copy"
    shutil.copytree(folder, copy, symlinks=True)
    told = commands.ask("look", folder)
    assert (told["version"], told["keyframes"]["count"]) == (1, len(bent.graph))
    place = commands.ask("keyframe", folder, seen=told["seen"], keyframe=K)
    assert place["pose"] == pytest.approx(bent.graph.map[K].tolist())
    assert len(place["points"]) == 2 * bent.graph.point_count[K]
    pairs = [pair_of(points, k).model_dump() for k in (6, 22) for points in bent.common_points(k)]
    change = {"what": "add-pair", "pairs": pairs}
    done = commands.ask("edit", copy, seen=told["seen"], who="ada", change=change)
    assert "moved by up to" in done["done"]
    assert bent.error_m(graph_in(copy)) < 0.10
    assert load_map(folder).number == 1
    assert map_log(copy)["versions"][-1]["who"] == "ada"


def test_an_area_needs_no_look_and_a_pair_needs_the_newest(folder):
    commands, wall = Asking(), {"what": "wall", "corners": [[0, 0], [1, 0]]}
    assert commands.ask("edit", folder, change=wall)["done"].startswith("drew a wall of 1.00 m")
    first = commands.ask("look", folder)["seen"]
    commands.ask("look", folder)
    for verb, request in (
        ("keyframe", {"seen": first, "keyframe": 0}),
        ("edit", {"seen": first, "change": {"what": "cut", "from_s": 0, "to_s": 1}}),
    ):
        answer = commands.ask(verb, folder, **request)
        assert not answer["ok"]
        assert "fetch them again" in answer["error"]
    assert load_map(folder).number == 2


@pytest.mark.parametrize(
    ("verb", "request_", "words"),
    [
        ("edit", {"change": {"what": "undo"}}, "undo"),
        ("edit", {"change": {"what": "wall", "corners": [[0, 0]] * 501}}, "at most 500"),
        ("edit", {"change": {"what": "erase", "corners": [[0, 0], [1, 0], [2, 0]]}}, "no area"),
        ("edit", {"more": 1, "change": {"what": "optimize"}}, "more"),
        ("keyframe", {"seen": "", "keyframe": -1}, "keyframe"),
        ("sell", {}, "look, keyframe and edit are known"),
    ],
)
def test_what_cannot_be_done_is_said_in_words(folder, verb, request_, words):
    answer = Asking().ask(verb, folder, **request_)
    assert not answer["ok"]
    assert words in answer["error"]
    assert load_map(folder).number == 1
