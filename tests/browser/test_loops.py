"""The loops of a stored map: listed with what they rest on, shown on the map, refused and accepted."""

import pytest

from service.mapstore.files import load_map, save_map
from service.offline.maps.loops import loops_of
from tests.browser.conftest import DESKTOP
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
    press(loops, "Loops not accepted", refused.index("taken back by hand"), "Accept")
    loops.answer()
    loops.wait_for("return corridor.edit.version === 3 && !corridor.edit.isBusy")
    assert len(load_map(tmp_path).graph.by_hand.pair_ends) == 2
    axe(loops, sizes=[DESKTOP], schemes=[False])
