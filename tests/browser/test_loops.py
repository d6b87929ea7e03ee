"""The loops of a stored map and of a running session: listed with what they rest on, refused and accepted."""

import pytest

from service.encoding import encode_graph
from service.mapper.graph.loops.loop_back_end import Batch
from service.mapstore.files import load_map, save_map
from service.offline.maps.loops import loops_of
from tests.browser.conftest import DESKTOP
from tests.browser.test_edit import wait_for_version
from tests.browser.test_edit_live import (
    map_process,  # noqa: F401 - a fixture
    mapping_of,
    session,  # noqa: F401 - a fixture
    wait_for_change,
)
from tests.service.offline.maps.bent_maps import tiles_of
from tests.service.offline.maps.test_loops import graph  # noqa: F401 - a fixture

ACCEPTED, REFUSED = "Accepted loops", "Loops not accepted"


def listed(page, kind):
    return page.texts(f".loops[aria-label='{kind}'] .stored-name")


def press(page, kind, number, words):
    page.run(
        "[...document.querySelectorAll(arguments[0])][arguments[1]].querySelectorAll('button')"
        ".forEach((button) => { if (button.textContent.startsWith(arguments[2])) button.click(); })",
        f".loops[aria-label='{kind}'] > li",
        number,
        words,
    )


def places_of(page, name):
    """Of both places, once they are shown."""
    places = "const {a, b} = corridor.edit.pairs.places;"
    page.wait_for(f"{places} return a.points.length > 0 && b.points.length > 0")
    return page.run(f"{places} return [a.{name}, b.{name}]")


def test_a_loop_is_shown_with_its_evidence_refused_and_accepted(page, opened, graph, tmp_path):  # noqa: F811
    save_map(tmp_path, tiles_of(graph), 1, graph=graph)
    opened(tmp_path)
    by_residual = sorted(loops_of(graph)[0], key=lambda loop: -loop["off_mm"])
    assert listed(page, ACCEPTED) == [f"Loop {loop['loop']}" for loop in by_residual[:50]]
    press(page, ACCEPTED, 0, "Show")
    assert places_of(page, "keyframe") == graph.loop_ends[by_residual[0]["loop"]].tolist()
    press(page, ACCEPTED, 0, "Refuse")
    page.answer()
    wait_for_version(page, 2)
    assert len(load_map(tmp_path).graph.loop_ends) == len(graph.loop_ends) - 1
    press(page, REFUSED, listed(page, REFUSED).index("refused by the operator"), "Accept")
    page.answer()
    wait_for_version(page, 3)
    assert len(load_map(tmp_path).graph.by_hand.pair_ends) == 2
    assert "refused by the operator" not in listed(page, REFUSED)


def test_axe_finds_nothing_serious_in_the_list_of_loops(axe, page, opened, graph, tmp_path):  # noqa: F811
    save_map(tmp_path, tiles_of(graph), 1, graph=graph)
    opened(tmp_path)
    axe(page, sizes=[DESKTOP], schemes=[False])


@pytest.fixture
def mapping(graph, tmp_path, monkeypatch):  # noqa: F811
    """Of `session`."""
    monkeypatch.setattr("service.web.live_view.GRAPH_PERIOD_NS", 0)
    return mapping_of(graph, tiles_of(graph), tmp_path)


def show_graph(page, session, mapping):  # noqa: F811
    picture = mapping.back_end.work(Batch([], "checkpoint")).picture
    session.put(encode_graph(picture, picture.stamp_ns))
    page.wait_for("return document.querySelector('.loops li')")
    return picture.evidence["accepted"]


def test_a_loop_of_a_running_session_is_listed_shown_refused_and_accepted(page, session, mapping, graph):  # noqa: F811
    worst = show_graph(page, session, mapping)[0]
    assert listed(page, ACCEPTED)[0] == f"Loop at {worst['back_at_s']:.0f} s"
    for words in ("points on walls", "in free space", "residual", "sigma", "of path later"):
        assert words in page.text("edit")
    press(page, ACCEPTED, 0, "Show")  # fetches the key frames first
    assert places_of(page, "stamp_ns") == worst["stamps_ns"]
    press(page, ACCEPTED, 0, "Refuse")
    page.answer()
    wait_for_change(page, "took back the loop from key frame")
    show_graph(page, session, mapping)
    page.wait_for("return document.querySelector('#loops').textContent.includes('refused by the operator')")
    press(page, REFUSED, listed(page, REFUSED).index("refused by the operator"), "Accept")
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
    others = show_graph(page, session, mapping)[1:]
    put = "const button = document.querySelector('.loops li button'), down = new PointerEvent('pointerdown', "
    put += "{bubbles: true}); if (arguments[1]) button.dispatchEvent(down); else button.focus();"
    put += "corridor.edit.loops.put({accepted: arguments[0]});"
    assert page.run(f"{put} return button.isConnected", others, True)
    page.run("window.dispatchEvent(new PointerEvent('pointerup'))")
    page.wait_for("return document.querySelectorAll('.loops li').length === arguments[0]", len(others))
    moved = [{**others[0], "off_mm": 0.0}, *others[1:]]
    assert page.run(f"{put} return document.activeElement === button", moved, False)
