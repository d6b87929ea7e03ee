"""Another profile, and another map, by the buttons of the page."""

import json

import pytest

from service.encoding import Status, encode_diagnostics
from service.publishing.commands import Answer
from tests.browser.conftest import PHONE, begin_live, requested, store_map
from tests.browser.scene import stamp

TAKEN_UP = "taken up, but not finished within 8 s; health tells how things stand"


def open_control(page):
    page.run(
        "corridor.connection.on.hello({run_id: '', vehicle: 'v', verbs: ['switch_profile', 'load_map'],"
        " profile: 'corridor', profiles: ['corridor', 'contour_lm', 'imle']})"
    )
    page.choose("control")


def options(page):
    return page.run("return [...document.getElementById('profile').options].map((option) => option.value)")


def test_a_profile_is_chosen_confirmed_and_asked_for_until_it_maps(page, live, dispatcher, monkeypatch):
    refused = "this session is localised in a stored map"
    answers = [
        {"ok": False, "error": TAKEN_UP},
        {"ok": True, "folder_before": "/maps/a"},
        {"ok": False, "error": refused},
    ]

    def answer(verb, payload):
        dispatcher.requested.append((verb, payload))
        return Answer(True, json.dumps(answers.pop(0)).encode())

    monkeypatch.setattr(live, "_answer", answer)
    open_control(page)
    assert options(page) == ["contour_lm", "imle"]  # not the one that maps
    page.put("profile", "imle")
    assert "keeps the map on disk" in page.text("control")
    page.element("do-switch_profile").click()
    page.answer("no")
    assert dispatcher.requested == []
    page.element("do-switch_profile").click()
    assert "begins a new, empty map" in page.text("confirm-text")
    page.answer()
    page.wait_for_text("notices", "imle maps now; the map before is in /maps/a.")
    (first, request), second = requested(dispatcher)
    assert (first, request["profile"]) == ("switch_profile", "imle")
    assert second == (first, request)  # with the same id, so that it is not done twice
    mapping = Status("mapping", 0, "ok", {"state": "ok", "profile": "imle"})
    live.put(encode_diagnostics("diagnostics", [mapping], stamp(2.0), stamp(2.0)))
    page.wait_for("return document.getElementById('profile').options[0].value === 'corridor'")
    assert options(page) == ["corridor", "contour_lm"]
    page.element("do-switch_profile").click()
    page.answer()
    page.wait_for_text("notices", f"Switch profile: {refused}.")
    page.wait_for("return !document.getElementById('do-switch_profile').disabled")
    page.run("corridor.connection.on.verbs({verbs: ['mark']})")
    assert not page.element("do-switch_profile").is_displayed()


@pytest.fixture
def ask_to_load(page, serve, scene, tmp_path):
    """A stored map, by the button of the area Resources; returns the server."""

    def ask(*verbs):
        store_map(tmp_path / "office")
        server = serve(folders={"session": tmp_path / "none", "map": tmp_path})
        begin_live(server, scene, page, verbs=verbs)
        page.wait_for("return !corridor.view.isLive")
        page.count_presses()
        page.choose("resources")
        page.wait_for_text("resources", "office")
        return server

    return ask


def test_a_stored_map_is_loaded_by_three_presses(page, ask_to_load, dispatcher):
    ask_to_load("load_map", "set_mode", "set_pose")
    loaded, mode = ("load_map", {"map": "office"}), ("set_mode", {"mode": "localization"})
    for choice, fault, words, asked in (
        ("yes", "", "office is loaded.", [loaded]),
        ("other", "", "office is loaded.", [loaded, mode]),
        ("other", "no map yet", "office is loaded, but the vehicle maps in it: no map yet", [loaded, mode]),
    ):
        page.run("document.getElementById('notices').replaceChildren()")
        dispatcher.requested.clear()
        dispatcher.faults["set_mode"] = fault
        page.press("Load\u2026 office")
        assert "lost until it is found" in page.text("confirm-text")
        page.answer(choice)
        page.wait_for_text("notices", words)
        assert requested(dispatcher) == asked
    assert page.presses() == 1 + 3 * 2  # the area once


def test_a_copy_is_loaded_again_where_the_vehicle_was(page, ask_to_load, scene, dispatcher):
    server = ask_to_load("load_map", "set_pose")
    server.put(scene.messages(2.0)[1])
    page.wait_for("return corridor.view.isLive")
    page.press("Load\u2026 office")
    page.answer()
    page.wait_for_text("notices", "office is loaded. Is it a copy of that one")
    page.driver.find_element("xpath", "//div[@id='notices']//button[text()='Set its pose']").click()
    page.wait_for_text("notices", "looked for where it was")
    (_, loaded), (verb, posed) = requested(dispatcher)
    assert (loaded, verb) == ({"map": "office"}, "set_pose")
    pose = scene.pose(2.0)
    assert posed == pytest.approx({"x_m": pose.x_m, "y_m": pose.y_m, "theta_rad": pose.theta_rad})


def test_the_card_fits_a_phone_and_passes_axe(axe, page, live):
    open_control(page)
    axe(page, "control", sizes=[PHONE], schemes=[False])
