"""Another profile, and another map, by the buttons of the page."""

import json

import pytest
from selenium.webdriver.common.keys import Keys

from service.encoding import Status, encode_diagnostics
from service.publishing.commands import Answer
from tests.browser.conftest import PHONE, begin_live, requested, store_map
from tests.browser.scene import stamp
from tests.service.web.conftest import TOKEN

VERBS = "['switch_profile', 'load_map']"


def open_control(page):
    page.run(
        f"corridor.connection.on.hello({{run_id: '', vehicle: 'v', verbs: {VERBS}, profile: 'corridor',"
        " profiles: ['corridor', 'contour_lm', 'imle']})"
    )
    page.choose("control")


def options(page):
    return page.run("return [...document.getElementById('profile').options].map((option) => option.value)")


def health_of(profile):
    return encode_diagnostics(
        "diagnostics",
        [Status("mapping", 0, "ok", {"state": "ok", "profile": profile})],
        stamp(2.0),
        stamp(2.0),
    )


def test_a_profile_is_chosen_confirmed_and_asked_for_until_it_maps(page, live, dispatcher, monkeypatch):
    answers = [
        {"ok": False, "error": "taken up, but not finished within 8 s; health tells how things stand"},
        {"ok": True, "folder_before": "/maps/a"},
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
    live.put(health_of("imle"))
    page.wait_for("return document.getElementById('profile').options[0].value === 'corridor'")
    assert options(page) == ["corridor", "contour_lm"]


def test_the_reason_why_a_profile_is_refused_is_shown(page, live, monkeypatch):
    words = "this session is localised in a stored map"
    refused = json.dumps({"ok": False, "error": words}).encode()
    monkeypatch.setattr(live, "_answer", lambda verb, payload: Answer(False, refused))
    open_control(page)
    page.element("do-switch_profile").click()
    page.answer()
    page.wait_for_text("notices", f"Switch profile: {words}.")
    page.wait_for("return !document.getElementById('do-switch_profile').disabled")


def test_without_the_token_and_without_the_verb_nothing_is_switched(page, serve, scene):
    begin_live(serve(), scene, page, token="")
    open_control(page)
    assert not page.element("do-switch_profile").is_enabled()
    page.run("corridor.connection.on.verbs({verbs: ['mark']})")
    assert not page.element("do-switch_profile").is_displayed()


def ask_to_load(page, serve, folder, verbs):
    """A stored map, by the button of the area Resources."""
    store_map(folder / "office")
    page.open(serve(folders={"session": folder / "none", "map": folder}).address, TOKEN)
    page.wait_for("return corridor.report().mayControl")
    page.run("corridor.connection.on.verbs({verbs: arguments[0]})", verbs)
    page.choose("resources")
    page.wait_for_text("resources", "office")
    page.press("Load\u2026 office")


def test_a_stored_map_is_loaded(page, serve, dispatcher, tmp_path):
    ask_to_load(page, serve, tmp_path, ["switch_profile", "load_map"])
    assert "lost until it is found" in page.text("confirm-text")
    page.answer()
    page.wait_for_text("notices", "office is loaded.")
    assert requested(dispatcher) == [("load_map", {"map": "office"})]


def test_a_map_that_is_loaded_but_cannot_be_localised_in_is_reported(page, serve, dispatcher, tmp_path):
    dispatcher.faults["set_mode"] = "there is no map yet"
    ask_to_load(page, serve, tmp_path, ["load_map", "set_mode", "set_pose"])
    page.answer("other")
    page.wait_for_text("notices", "office is loaded, but the vehicle maps in it: there is no map yet")
    assert requested(dispatcher) == [("load_map", {"map": "office"}), ("set_mode", {"mode": "localization"})]


def test_a_copy_is_saved_and_loaded_again_where_the_vehicle_was(page, serve, scene, dispatcher, tmp_path):
    store_map(tmp_path / "copy")
    server = serve(folders={"session": tmp_path / "none", "map": tmp_path})
    begin_live(server, scene, page, verbs=["save_map", "load_map", "set_pose"])
    page.choose("control")
    page.element("save-as").click()
    page.element("confirm-input").send_keys(Keys.CONTROL, "a")
    page.element("confirm-input").send_keys("copy", Keys.ENTER)
    page.wait_for_text("notices", "Save map: done")
    page.choose("resources")
    page.wait_for_text("resources", "copy")
    server.put(scene.messages(2.0)[1])
    page.wait_for("return corridor.view.isLive")
    page.press("Load\u2026 copy")
    page.answer()
    page.wait_for_text("notices", "copy is loaded. Is it a copy of that one")
    page.driver.find_element("xpath", "//div[@id='notices']//button[text()='Set its pose']").click()
    page.wait_for_text("notices", "looked for where it was")
    (_, saved), (_, loaded), (verb, posed) = requested(dispatcher)
    assert (saved, loaded, verb) == ({"name": "copy"}, {"map": "copy"}, "set_pose")
    pose = scene.pose(2.0)
    assert posed == pytest.approx({"x_m": pose.x_m, "y_m": pose.y_m, "theta_rad": pose.theta_rad})


def test_the_card_fits_a_phone_and_passes_axe(axe, page, live):
    open_control(page)
    axe(page, "control", sizes=[PHONE], schemes=[False])
