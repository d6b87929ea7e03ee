"""How many presses of mouse or finger a task takes, from the area Information on."""

import pytest

from tests.browser.conftest import begin_live, requested, store_map
from tests.browser.test_control import put_health
from tests.browser.test_edit import optimise, residuals_m
from tests.browser.test_edit_live import (
    erase,
    map_process,  # noqa: F401 - a fixture
    mapping,  # noqa: F401 - a fixture
    session,  # noqa: F401 - a fixture
    wait_for_change,
)

VERBS = ["save_map", "load_map", "set_mode", "set_pose"]


def begin(page):
    page.choose("information")
    page.run(
        "window.presses = 0;"
        "window.countPress ??= addEventListener('pointerdown', () => { window.presses += 1; }, true) ?? 1"
    )


def presses(page):
    return page.run("return window.presses")


@pytest.fixture
def stocked(page, serve, scene, dispatcher, tmp_path):
    """A page with the token; a map is stored."""
    store_map(tmp_path / "office")
    begin_live(serve(folders={"session": tmp_path / "none", "map": tmp_path}), scene, page, verbs=VERBS)
    begin(page)
    return page


def test_saving_the_map_takes_two_presses(stocked, dispatcher):
    stocked.choose("control")
    stocked.element("do-save_map").click()
    stocked.wait_for_answers()
    assert requested(dispatcher) == [("save_map", {})]
    assert presses(stocked) == 2


def test_loading_a_map_and_localising_in_it_takes_three_presses(stocked, dispatcher):
    stocked.choose("resources")
    stocked.wait_for_text("resources", "office")
    stocked.press("Load\u2026 office")
    stocked.element("confirm-other").click()
    stocked.wait_for_text("notices", "office is loaded.")
    assert requested(dispatcher) == [("load_map", {"map": "office"}), ("set_mode", {"mode": "localization"})]
    assert presses(stocked) == 3


def test_setting_the_pose_of_a_lost_vehicle_takes_three_presses(stocked, dispatcher):
    put_health(stocked, {"state": "lost"})
    stocked.choose("control")
    stocked.element("do-set_pose").click()
    stocked.pointer().drag_and_drop_by_offset(stocked.element("map"), 0, -60).perform()
    stocked.wait_for_answers()
    assert [verb for verb, _ in requested(dispatcher)] == ["set_pose"]
    assert presses(stocked) == 3


def test_erasing_a_ghost_takes_three_presses(page, session, mapping):  # noqa: F811
    begin(page)
    page.choose("edit")
    erase(page, mapping)
    assert presses(page) == 3


def test_joining_two_passes_that_lie_apart_takes_five_presses(page, session, mapping, bent):  # noqa: F811
    assert bent.error_m(mapping.graph()) > 0.5
    begin(page)
    page.choose("edit")
    page.element("fetch-keyframes").click()
    wait_for_change(page, "Fetched")
    page.driver.find_element("css selector", "#passes button").click()
    page.wait_for("return corridor.edit.pairs.pairs.length === 3")
    assert max(residuals_m(page)) > 0.5
    optimise(page)
    wait_for_change(page, "pairs 0 to 2; key frames moved by up to ")
    assert bent.error_m(mapping.graph()) < 0.10
    assert max(residuals_m(page)) < 0.05
    assert presses(page) == 5
    assert page.run("return corridor.edit.pairs.passes.length") == 0
