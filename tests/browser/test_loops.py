"""The loops of a stored map and of a running session: listed with what they rest on, refused and accepted."""

import pytest

from service.encoding import encode_graph
from service.mapper.graph.loops.loop_batches import Batch
from service.mapstore.files import load_map, save_map
from service.offline.maps.loops import loops_of
from tests.browser.conftest import DESKTOP
from tests.browser.test_edit_live import (
    map_process,  # noqa: F401 - a fixture
    mapping_of,
    session,  # noqa: F401 - a fixture
    wait_for_change,
)
from tests.service.offline.maps.bent_maps import tiles_of
from tests.service.offline.maps.test_loops import graph  # noqa: F401 - a fixture

LIST = (
    "return [...document.querySelectorAll(`.loops[aria-label='${arguments[0]}'] .stored-name`)]"
    ".map((p) => p.textContent)"
)


@pytest.fixture
def loops(page, opened, graph, tmp_path):  # noqa: F811
    save_map(tmp_path, tiles_of(graph), 1, graph=graph)
    opened(tmp_path)
    return page


def press(page, kind, number, words):
    page.run(
        "const list = document.querySelector(`.loops[aria-label='${arguments[0]}']`);"
        "[...list.children[arguments[1]].querySelectorAll('button')]"
        ".find((b) => b.textContent.startsWith(arguments[2])).click()",
        kind,
        number,
        words,
    )


def test_a_loop_is_shown_with_its_evidence_refused_and_accepted(loops, graph, tmp_path, axe):  # noqa: F811
    accepted = loops.run(LIST, "Accepted loops")
    by_residual = sorted(loops_of(graph)[0], key=lambda loop: -loop["off_mm"])
    assert accepted == [f"Loop {loop['loop']}" for loop in by_residual[:50]]
    worst = by_residual[0]["loop"]
    assert "residual" in loops.text("edit")
    assert "on walls" in loops.text("edit")
    press(loops, "Accepted loops", 0, "Show")
    places = "const {a, b} = corridor.edit.pairs.places;"
    loops.wait_for(f"{places} return a.points.length > 0 && b.points.length > 0")
    assert loops.run(f"{places} return [a.keyframe, b.keyframe]") == graph.loop_ends[worst].tolist()
    press(loops, "Accepted loops", 0, "Refuse")
    loops.answer()
    loops.wait_for("return corridor.edit.version === 2 && !corridor.edit.isBusy")
    assert len(load_map(tmp_path).graph.loop_ends) == len(graph.loop_ends) - 1
    refused = loops.run(LIST, "Loops not accepted")
    press(loops, "Loops not accepted", refused.index("refused by the operator"), "Accept")
    loops.answer()
    loops.wait_for("return corridor.edit.version === 3 && !corridor.edit.isBusy")
    assert len(load_map(tmp_path).graph.by_hand.pair_ends) == 2
    assert "refused by the operator" not in loops.run(LIST, "Loops not accepted")
    axe(loops, sizes=[DESKTOP], schemes=[False])


@pytest.fixture
def mapping(graph, tmp_path, monkeypatch):  # noqa: F811
    """Of `session`."""
    monkeypatch.setattr("service.web.live_view.GRAPH_PERIOD_NS", 0)
    return mapping_of(graph, tiles_of(graph), tmp_path)


def test_a_loop_of_a_running_session_is_listed_shown_refused_and_accepted(page, session, mapping, graph):  # noqa: F811
    def show_graph():
        picture = mapping.back_end.work(Batch([], "checkpoint")).picture
        session.put(encode_graph(picture, picture.stamp_ns))
        return picture.evidence

    evidence = show_graph()
    worst = evidence["accepted"][0]
    name = f"Loop at {worst['back_at_s']:.0f} s"
    page.wait_for("return document.querySelector('.loops .stored-name')")
    assert page.run(LIST, "Accepted loops")[0] == name
    for words in ("points on walls", "in free space", "residual", "sigma", "of path later"):
        assert words in page.text("edit")
    press(page, "Accepted loops", 0, "Show")  # fetches the key frames first
    places = "const {a, b} = corridor.edit.pairs.places;"
    page.wait_for(f"{places} return a.points.length > 0 && b.points.length > 0")
    assert page.run(f"{places} return [a.stamp_ns, b.stamp_ns]") == worst["stamps_ns"]
    press(page, "Accepted loops", 0, "Refuse")
    page.answer()
    wait_for_change(page, "took back the loop from key frame")
    show_graph()
    page.wait_for(LIST + ".includes('refused by the operator')", "Loops not accepted")
    refused = page.run(LIST, "Loops not accepted").index("refused by the operator")
    press(page, "Loops not accepted", refused, "Accept")
    page.answer()
    wait_for_change(page, "accepted the loop from key frame")
    requested = [request["change"] for verb, request in mapping.requested if verb == "edit_map"]
    assert [(change["what"], change["stamps_ns"]) for change in requested] == [
        ("refuse-loop", worst["stamps_ns"]),
        ("accept-loop", worst["stamps_ns"]),
    ]
    assert len(mapping.graph().loop_ends) == len(graph.loop_ends) - 1
    assert len(mapping.graph().by_hand.pair_ends) == 2


def test_what_is_pressed_in_the_list_of_loops_is_not_moved_until_it_is_released(page, session, mapping):  # noqa: F811
    picture = mapping.back_end.work(Batch([], "checkpoint")).picture
    session.put(encode_graph(picture, picture.stamp_ns))
    page.wait_for("return document.querySelector('.loops li')")
    put = "corridor.edit.loops.put({accepted: arguments[0]})"
    others = [*picture.evidence["accepted"][1:]]
    first = page.run(
        "const button = document.querySelector('.loops li button');"
        "button.dispatchEvent(new PointerEvent('pointerdown', {bubbles: true}));"
        f"{put}; return button.isConnected",
        others,
    )
    assert first
    page.run("window.dispatchEvent(new PointerEvent('pointerup'))")
    page.wait_for(LIST + ".length === arguments[1]", "Accepted loops", len(others))
    kept = page.run(
        "const button = document.querySelector('.loops li button'); button.focus();"
        f"{put}; return document.activeElement === button",
        [{**others[0], "off_mm": 0.0}, *others[1:]],
    )
    assert kept
