"""Points of two places picked side by side, each in a pane of its own."""

import numpy as np
import pytest
from selenium.webdriver.common.keys import Keys

from tests.browser.conftest import DESKTOP, PHONE
from tests.browser.test_edit import (
    PAIRED,
    optimise,
    unchanged,  # noqa: F401 - a fixture
    unchanged_view,  # noqa: F401 - a fixture
    view,  # noqa: F401 - a fixture
    wait_for_version,
)
from tests.service.offline.maps.bent_maps import ROUND, graph_in

PIXELS_PER_M = 150.0


def choose_places(page, k):
    page.run(
        "const {a, b} = corridor.edit.pairs.places; a.choose(arguments[0]); b.choose(arguments[1])",
        k,
        k + ROUND,
    )
    page.wait_for(
        "const {a, b} = corridor.edit.pairs.places;"
        "return a.points.length && b.points.length && !a.loading && !b.loading"
    )


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


def look_in_pane(page, x_m, y_m):
    page.run(
        "const {pane} = corridor.edit.pairs; pane.camera.centreOn(arguments[0], arguments[1]);"
        "pane.camera.scale = arguments[2]; window.paneBefore = pane.frames; pane.invalidate()",
        float(x_m),
        float(y_m),
        PIXELS_PER_M,
    )
    page.wait_for("return corridor.edit.pairs.pane.frames > window.paneBefore")


def click_middle(page, name):
    page.pointer().move_to_element(page.element(name)).click().perform()


def pick(page, of_a, of_b, order="ab"):
    page.look_at(*of_a, PIXELS_PER_M)
    look_in_pane(page, *of_b)
    for side in order:
        click_middle(page, "map" if side == "a" else "pane")


def test_a_bent_map_is_straightened_in_two_panes_in_either_order(page, view, folder, bent):  # noqa: F811
    open_panes(page)
    expected = bent.common_points(PAIRED[0])
    for (first, second), order in zip(expected, ("ab", "ba", "ab"), strict=True):
        pick(page, first, second, order)
    points = page.run("return corridor.edit.pairs.pairs.map((pair) => pair.points)")
    assert np.abs(np.array(points) - expected).max() < 0.15  # a point, or the corner that is near it
    optimise(page)
    wait_for_version(page, 2)
    assert bent.error_m(graph_in(folder)) < 0.10
    assert page.run("return corridor.edit.pairs.pane.isOpen")
    assert page.faults() == []


def test_each_pane_shows_its_own_place(panes, bent):
    page, k = panes, PAIRED[0]
    of_a, of_b = bent.common_points(k)[2]
    page.run("Object.assign(corridor.view.layers, {map: 0, path: 0, grid: 0})")
    colours = page.run("return corridor.view.colours.places")
    assert colours["a"] != colours["b"]
    pixel = (
        "const [canvas, camera, x, y] = arguments; const [sx, sy] = camera;"
        "return [...document.getElementById(canvas).getContext('2d').getImageData(sx, sy, 1, 1).data]"
    )

    def seen(name, camera, xy_m):
        at = page.run(f"return {camera}.toScreen(arguments[0], arguments[1])", *map(float, xy_m))
        return page.run(pixel, name, at, 0, 0)[:3]

    for xy_m, in_map, in_pane in ((of_a, True, False), (of_b, False, True)):
        page.look_at(*xy_m, PIXELS_PER_M)
        look_in_pane(page, *xy_m)
        assert (seen("map", "corridor.view.camera", xy_m) == [194, 65, 12]) == in_map
        assert (seen("pane", "corridor.edit.pairs.pane.camera", xy_m) == [109, 40, 217]) == in_pane


def test_points_are_picked_in_the_panes_with_keys_alone(panes, bent):
    page = panes
    of_a, of_b = bent.common_points(PAIRED[0])[0]
    page.look_at(*of_a, 400.0)
    look_in_pane(page, *of_b)
    page.element("pane").send_keys(Keys.ENTER)
    page.wait_for_text("hint", "in the pane of place A")
    page.element("pane").send_keys(Keys.BACKSPACE)
    page.wait_for_text("hint", "Click a point in one pane")
    page.element("map").send_keys(Keys.ENTER)
    page.wait_for_text("hint", "in the pane of place B")
    pane = page.element("pane")
    before = page.run("const c = corridor.edit.pairs.pane.camera; return [c.x_m, c.scale, c.rotation_rad]")
    main = page.run("const c = corridor.view.camera; return [c.x_m, c.scale, c.rotation_rad]")
    for keys in (Keys.ARROW_RIGHT, "+", "["):
        pane.send_keys(keys)
    after = page.run("const c = corridor.edit.pairs.pane.camera; return [c.x_m, c.scale, c.rotation_rad]")
    assert all(was != now for was, now in zip(before, after, strict=True))
    assert page.run("const c = corridor.view.camera; return [c.x_m, c.scale, c.rotation_rad]") == main
    look_in_pane(page, *of_b)
    pane.send_keys(Keys.ENTER)
    assert page.run("return corridor.edit.pairs.pairs.length") == 1


def test_the_second_pane_goes_when_it_is_not_wanted(panes):
    page = panes
    is_open = "return corridor.edit.pairs.pane.isOpen"
    half = page.element("map").size["width"]
    page.element("side-by-side").click()
    assert not page.run(is_open)
    assert not page.element("pane").is_displayed()
    page.wait_for("return corridor.view.camera.width > arguments[0] * 1.9", half)
    page.element("side-by-side").click()
    assert page.run(is_open)
    page.element("draw-wall").click()  # one map to draw on
    assert not page.run(is_open)
    page.element("side-by-side").click()
    assert page.run(is_open)
    assert page.element("pick-pairs").get_attribute("aria-pressed") == "true"
    page.element("forget-places").click()
    assert not page.run(is_open)
    assert not page.element("side-by-side").is_enabled()


def test_another_place_that_is_chosen_comes_into_its_pane(panes, bent):
    page, k = panes, PAIRED[1]
    choose_places(page, k)
    middle = page.run("const c = corridor.edit.pairs.pane.camera; return [c.x_m, c.y_m]")
    assert middle == pytest.approx(bent.graph.map[k + ROUND, :2].tolist(), abs=1e-3)


def test_axe_finds_nothing_serious_in_two_panes(axe, panes):
    axe(panes, "edit", sizes=[DESKTOP], shown="pane")
    axe(panes, "map", sizes=[PHONE], shown="pane")
