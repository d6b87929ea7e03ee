"""Points of two places picked side by side, each in a pane of its own."""

import numpy as np
import pytest
from selenium.webdriver.common.keys import Keys

from tests.browser.conftest import DESKTOP, PHONE
from tests.browser.test_edit import (
    PAIRED,
    choose_places,
    optimise,
    unchanged,  # noqa: F401 - a fixture
    unchanged_view,  # noqa: F401 - a fixture
    view,  # noqa: F401 - a fixture
    wait_for_version,
)
from tests.service.offline.maps.bent_maps import ROUND, graph_in

PIXELS_PER_M = 150.0
CAMERAS = {"map": "corridor.view.camera", "pane": "corridor.edit.pairs.pane.camera"}
IS_OPEN = "return corridor.edit.pairs.pane.isOpen"


def open_panes(page):
    """Two of them, on the places of the first key frame."""
    choose_places(page, PAIRED[0])
    page.element("side-by-side").click()
    page.wait_for("const {pane} = corridor.edit.pairs; return pane.isOpen && pane.frames > 0")


@pytest.fixture
def panes(unchanged):  # noqa: F811
    """Two panes open, on a shared page."""
    open_panes(unchanged)
    return unchanged


def look(page, of_a, of_b, pixels_per_m=PIXELS_PER_M):
    """At a point in each pane."""
    page.look_at(*of_a, pixels_per_m)
    page.run(
        "const {pane} = corridor.edit.pairs; pane.camera.centreOn(arguments[0], arguments[1]);"
        "pane.camera.scale = arguments[2]; window.paneBefore = pane.frames; pane.invalidate()",
        *map(float, of_b),
        PIXELS_PER_M,
    )
    page.wait_for("return corridor.edit.pairs.pane.frames > window.paneBefore")


def camera_of(page, pane):
    return page.run(f"const c = {CAMERAS[pane]}; return [c.x_m, c.y_m, c.scale, c.rotation_rad]")


def test_a_bent_map_is_straightened_in_two_panes_in_either_order(page, view, folder, bent):  # noqa: F811
    open_panes(page)
    expected = bent.common_points(PAIRED[0])
    for points, order in zip(expected, ("ab", "ba", "ab"), strict=True):
        look(page, *points)
        for side in order:
            pane = page.element("map" if side == "a" else "pane")
            page.pointer().move_to_element(pane).click().perform()
    points = page.run("return corridor.edit.pairs.pairs.map((pair) => pair.points)")
    assert np.abs(np.array(points) - expected).max() < 0.15  # a point, or the corner that is near it
    optimise(page)
    wait_for_version(page, 2)
    assert bent.error_m(graph_in(folder)) < 0.10
    assert page.run(IS_OPEN)
    assert page.faults() == []


def test_each_pane_shows_its_own_place(panes, bent):
    of_a, of_b = bent.common_points(PAIRED[0])[2]
    panes.run("Object.assign(corridor.view.layers, {map: 0, path: 0, grid: 0})")

    def is_seen(pane, colour, xy_m):
        shown = panes.run(
            f"const at = {CAMERAS[pane]}.toScreen(arguments[1], arguments[2]);"
            "const context = document.getElementById(arguments[0]).getContext('2d');"
            "return [...context.getImageData(...at, 1, 1).data]",
            pane,
            *map(float, xy_m),
        )
        return shown[:3] == colour

    for xy_m, in_map, in_pane in ((of_a, True, False), (of_b, False, True)):
        look(panes, xy_m, xy_m)
        assert is_seen("map", [194, 65, 12], xy_m) == in_map
        assert is_seen("pane", [109, 40, 217], xy_m) == in_pane


def test_points_are_picked_in_the_panes_with_keys_alone(panes, bent):
    of_a, of_b = bent.common_points(PAIRED[0])[0]
    look(panes, of_a, of_b, 400.0)
    for pane, key, hint in (
        ("pane", Keys.ENTER, "in the pane of place A"),
        ("pane", Keys.BACKSPACE, "Click a point in one pane"),
        ("map", Keys.ENTER, "in the pane of place B"),
    ):
        panes.element(pane).send_keys(key)
        panes.wait_for_text("hint", hint)
    before, of_map = camera_of(panes, "pane"), camera_of(panes, "map")
    panes.element("pane").send_keys(Keys.ARROW_RIGHT, Keys.ARROW_UP, "+", "[")
    assert all(was != now for was, now in zip(before, camera_of(panes, "pane"), strict=True))
    assert camera_of(panes, "map") == of_map
    look(panes, of_a, of_b, 400.0)
    panes.element("pane").send_keys(Keys.ENTER)
    assert panes.run("return corridor.edit.pairs.pairs.length") == 1


def test_the_second_pane_goes_when_it_is_not_wanted(panes):
    half = panes.element("map").size["width"]
    for pressed, is_open in (
        ("side-by-side", False),
        ("side-by-side", True),
        ("draw-wall", False),  # one map to draw on
        ("side-by-side", True),
        ("forget-places", False),
    ):
        panes.element(pressed).click()
        assert panes.run(IS_OPEN) == is_open == panes.element("pane").is_displayed()
        is_picking = panes.element("pick-pairs").get_attribute("aria-pressed") == "true"
        assert is_picking or not is_open
    panes.wait_for("return corridor.view.camera.width > arguments[0] * 1.9", half)
    assert not panes.element("side-by-side").is_enabled()


def test_another_place_that_is_chosen_comes_into_its_pane(panes, bent):
    choose_places(panes, PAIRED[1])
    there = bent.graph.map[PAIRED[1] + ROUND, :2].tolist()
    assert camera_of(panes, "pane")[:2] == pytest.approx(there, abs=1e-3)


def test_axe_finds_nothing_serious_in_two_panes(axe, panes):
    axe(panes, "edit", sizes=[DESKTOP], shown="pane")
    axe(panes, "map", sizes=[PHONE], shown="pane")
