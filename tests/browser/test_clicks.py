"""How many presses of mouse or finger a task takes, from the area Information on."""

import pytest

from tests.browser.conftest import asked, store_map
from tests.browser.test_control import put_state
from tests.browser.test_edit import drag_map, residuals_m
from tests.browser.test_edit_live import (
    ERASED,
    map_process,  # noqa: F401 - a fixture
    mapping,  # noqa: F401 - a fixture
    points_within,
    session,  # noqa: F401 - a fixture
    wait_for_change,
)
from tests.service.web.conftest import TOKEN

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
    server = serve(folders={"session": tmp_path / "none", "map": tmp_path})
    for message in scene.messages(1.0):
        server.put(message)
    page.open(server.address, TOKEN)
    page.wait_for("const r = corridor.report(); return r.mayControl && r.pose && r.health")
    page.run("corridor.connection.on.verbs({verbs: arguments[0]})", VERBS)
    begin(page)
    return page


def test_the_map_is_saved_by_two(stocked, dispatcher):
    stocked.choose("control")
    stocked.element("do-save_map").click()
    stocked.wait_for_answers()
    assert asked(dispatcher) == [("save_map", {})]
    assert presses(stocked) == 2


def test_a_map_is_loaded_and_localised_in_by_three(stocked, dispatcher):
    stocked.choose("resources")
    stocked.wait_for_text("resources", "office")
    stocked.driver.find_element("css selector", '[aria-label="Load\u2026 office"]').click()
    stocked.element("confirm-other").click()
    stocked.wait_for_text("notices", "office is loaded.")
    assert asked(dispatcher) == [("load_map", {"map": "office"}), ("set_mode", {"mode": "localization"})]
    assert presses(stocked) == 3


def test_the_pose_of_a_lost_vehicle_is_set_by_three(stocked, dispatcher):
    put_state(stocked, "lost")
    stocked.choose("control")
    stocked.element("do-set_pose").click()
    stocked.pointer().drag_and_drop_by_offset(stocked.element("map"), 0, -60).perform()
    stocked.wait_for_answers()
    assert [verb for verb, _ in asked(dispatcher)] == ["set_pose"]
    assert presses(stocked) == 3


def test_a_ghost_is_erased_by_three(page, session, mapping):  # noqa: F811
    begin(page)
    page.look_at(*ERASED.mean(axis=0), 100.0)
    page.choose("edit")
    page.element("draw-rectangle").click()
    drag_map(page, *ERASED)
    wait_for_change(page, "erased 0.6")
    assert points_within(mapping.graph()) == 0
    assert presses(page) == 3


def test_two_passes_that_lie_apart_are_joined_by_five(page, session, mapping, bent):  # noqa: F811
    assert bent.error_m(mapping.graph()) > 0.5
    begin(page)
    page.choose("edit")
    page.element("fetch-keyframes").click()
    wait_for_change(page, "Fetched")
    page.driver.find_element("css selector", "#passes button").click()
    page.wait_for("return corridor.edit.pairs.pairs.length === 3")
    assert max(residuals_m(page)) > 0.5
    page.element("optimise").click()
    page.wait_for("return document.getElementById('confirm').open")
    page.element("confirm-yes").click()
    wait_for_change(page, "pairs 0 to 2; key frames moved by up to ")
    assert bent.error_m(mapping.graph()) < 0.10
    assert max(residuals_m(page)) < 0.05
    assert presses(page) == 5
    assert page.run("return corridor.edit.pairs.passes.length") == 0
