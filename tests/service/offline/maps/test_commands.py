"""What the operator's page asks of a stored map: bounded, one at a time, each change a version on disk."""

import json
import threading

import numpy as np
import pytest

from service.geometry import poses as se2
from service.mapstore.files import load_map, versions_of
from service.offline.maps import edit as map_edit
from service.offline.maps.commands import MapCommands
from tests.in_background import started
from tests.service.offline.maps.bent_maps import ROUND, graph_in
from tests.service.web.conftest import TIMEOUT_S

SQUARE = [[0.5, 0.5], [1.5, 0.5], [1.5, 1.5], [0.5, 1.5]]


class Asking:
    """The commands of a map, what one asks of them, and the versions that they showed."""

    def __init__(self, folder):
        self.shown = []
        self.commands = MapCommands(folder, load_map(folder), lambda stored: self.shown.append(stored.number))

    def ask(self, verb, **request):
        answer = self.commands.answer(verb, json.dumps(request).encode())
        body = json.loads(answer.body)
        assert body["ok"] is answer.ok
        return body

    def edit(self, version, what, who="ada", **change):
        return self.ask("map_edit", version=version, who=who, change={"what": what, **change})


def test_the_points_of_a_key_frame_lie_in_the_map(folder, bent):
    facts = Asking(folder).ask("map_keyframe", version=1, keyframe=ROUND + 3)
    k = ROUND + 3
    begin = bent.graph.point_count[:k].sum()
    seen = bent.graph.xy_base[begin : begin + bent.graph.point_count[k]].astype(float)
    expected = se2.points_from(graph_in(folder).map[k], seen)
    np.testing.assert_allclose(np.reshape(facts["points"], (-1, 2)), expected, atol=2e-3)
    assert "no key frame 9999" in Asking(folder).ask("map_keyframe", version=1, keyframe=9999)["error"]
    assert "this is of version 7" in Asking(folder).ask("map_keyframe", version=7, keyframe=0)["error"]


def test_pairs_of_points_straighten_the_map(folder, bent):
    asking = Asking(folder)
    assert bent.error_m(graph_in(folder)) > 0.5
    pairs = [
        {"points": points.tolist(), "keyframes": [k, k + ROUND]}
        for k in (6, 22)
        for points in bent.common_points(k)
    ]
    facts = asking.edit(1, "add-pair", pairs=pairs)
    assert facts["ok"], facts
    assert [added["pair"] for added in facts["added"]] == list(range(6))
    assert [added["keyframes"] for added in facts["added"]] == [pair["keyframes"] for pair in pairs]
    assert facts["done"].startswith("pairs 0 to 5 about (")
    assert bent.error_m(graph_in(folder)) < 0.10
    assert asking.shown == [2]
    looked = asking.ask("map_look")
    assert (looked["versions"][1]["who"], looked["versions"][1]["what"]) == ("ada", "add-pair")
    assert max(pair["apart_mm"] for pair in looked["pairs"]) < 50.0
    assert asking.edit(2, "remove-pair", pair=5)["ok"]
    assert len(asking.ask("map_look")["pairs"]) == 5
    assert asking.edit(3, "undo")["version"] == 4
    assert asking.edit(4, "undo", to=1)["ok"]
    np.testing.assert_array_equal(graph_in(folder).map, bent.graph.map)
    assert asking.shown == [2, 3, 4, 5]


def test_areas_walls_and_time_spans_are_changed_as_by_the_command(folder):
    asking = Asking(folder)
    assert asking.edit(1, "erase", corners=SQUARE, becomes="free")["done"].startswith("erased 1.00 m2")
    assert asking.edit(2, "wall", corners=[[0, 0], [1, 0]])["done"].startswith("drew a wall of 1.00 m")
    assert "would be disconnected" in asking.edit(3, "cut", from_s=3.0, to_s=4.05)["error"]
    facts = asking.edit(3, "cut", from_s=3.0, to_s=4.05, bridge=True)
    assert facts["keyframes_gone"] == 11
    assert asking.edit(4, "optimize", who="")["ok"]
    edits = [(v["who"], v["what"]) for v in asking.ask("map_look")["versions"][1:]]
    assert edits == [("ada", "erase"), ("ada", "wall"), ("ada", "cut"), (map_edit.user_name(), "optimize")]


def test_a_map_without_a_graph_can_be_drawn_in_and_nothing_else(picture):
    asking = Asking(picture)
    assert "it knows map_look, map_keyframe, map_version, map_edit" in asking.ask("reset_map")["error"]
    assert "Extra inputs" in asking.ask("map_look", more=1)["error"]
    assert asking.ask("map_look")["keyframes"] is None
    assert asking.edit(1, "erase", corners=SQUARE)["cells_changed"] == 4
    assert "what was shown, not what it was made of" in asking.edit(2, "optimize")["error"]
    assert "no key frame 0" in asking.ask("map_keyframe", version=2, keyframe=0)["error"]


def test_a_change_meant_for_an_older_version_is_refused_and_the_newer_one_shown(picture):
    asking = Asking(picture)
    map_edit.edit_map(picture, "wall", map_edit.wall([0, 0, 1, 0]), "bob", 5)
    facts = asking.edit(1, "erase", corners=SQUARE)
    assert "the map is at version 2, and the change was meant for version 1" in facts["error"]
    assert asking.shown == [2]
    assert asking.edit(2, "undo", to=1)["ok"]
    assert "meant for version 2" in asking.edit(2, "undo", to=1)["error"]


def test_changes_are_made_one_at_a_time(picture):
    begun, go_on = threading.Event(), threading.Event()

    def show(stored):
        begun.set()
        assert go_on.wait(TIMEOUT_S)

    commands = MapCommands(picture, load_map(picture), show)
    request = json.dumps({"version": 1, "change": {"what": "wall", "corners": [[0, 0], [1, 0]]}}).encode()
    first = started(lambda: commands.answer("map_edit", request))
    try:
        assert begun.wait(TIMEOUT_S)
        assert (
            "another change of this map is being made" in commands.answer("map_edit", request).body.decode()
        )
    finally:
        go_on.set()
        first.result(TIMEOUT_S)
    assert commands.answer("map_look", b"{}").ok


@pytest.fixture(scope="module")
def unchanged(bent_folder):
    return Asking(bent_folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"what": "erase", "corners": [[0, 0], [1, 1]]}, "expected X Y of 3 points or more"),
        ({"what": "erase", "corners": [[0, k] for k in range(501)]}, "501 points, at most 500 are taken"),
        ({"what": "wall", "corners": [[0, k] for k in range(501)]}, "501 points, at most 500 are taken"),
        ({"what": "erase", "corners": [[0, 0], [200, 0], [200, 100]]}, "200 m x 100 m, more than 10000 m2"),
        ({"what": "wall", "corners": [[0, 0], [500, 500]]}, "draw it through more points"),
        ({"what": "wall", "corners": [[1e9, 0], [1e9, 1]]}, "reaches 1e+09 m from the origin"),
        ({"what": "wall", "corners": [[0, 0], [1, None]]}, "valid number"),
        ({"what": "add-pair", "pairs": []}, "at least 1 item"),
        (
            {"what": "add-pair", "pairs": [{"points": [[0, 0], [1, 0]], "keyframes": [0, 1]}] * 101},
            "101 pairs, at most 100 are taken",
        ),
        ({"what": "add-pair", "pairs": [{"points": [[0, 0], [1, 0]], "keyframes": [3, 3]}]}, "key frame 3"),
        ({"what": "cut", "from_s": 5000, "to_s": 6000}, "no key frame lies in that time"),
        ({"what": "remove-pair", "pair": 0}, "there is no pair 0"),
        ({"what": "undo"}, "no edit that could be taken back"),
        ({"what": "melt"}, "does not match any of the expected tags"),
    ],
)
def test_what_is_no_change_is_refused_in_words(unchanged, bent_folder, change, words):
    assert words in unchanged.ask("map_edit", version=1, change=change)["error"]
    assert unchanged.shown == []
    assert versions_of(bent_folder)[1] == 1
