"""The area Control of the page: what each control sends, and why one is disabled."""

import pytest
from selenium.webdriver.common.keys import Keys

from tests.browser.conftest import requested


@pytest.fixture
def control(still, still_dispatcher):
    """The shared page at its area Control, with all commands and no notice; no command was given."""
    verbs = "['mark', 'save_map', 'reset_map', 'set_pose', 'set_mode', 'edit_map']"
    still.run(f"corridor.connection.on.hello({{run_id: '', vehicle: 'v', verbs: {verbs}}})")
    still.run("document.getElementById('notices').replaceChildren()")
    still_dispatcher.requested.clear()
    still.count_presses()
    still.choose("control")
    return still


def test_commands_are_given_with_the_token(control, still_dispatcher):
    control.element("do-save_map").click()
    control.wait_for_text("notices", "Save map: done.")
    assert control.presses() == 2
    control.element("mark-text").send_keys("a door", Keys.ENTER)
    control.wait_for_text("notices", "Set mark: done.")
    assert requested(still_dispatcher) == [("save_map", {}), ("mark", {"text": "a door"})]


def test_a_name_that_cannot_be_is_refused_before_it_is_sent(control, still_dispatcher):
    control.element("save-as").click()
    name = control.element("confirm-input")
    for wrong in ("../lap", "lap 1", ""):
        name.clear()
        name.send_keys(wrong, Keys.ENTER)
        assert control.run("return document.getElementById('confirm').open")
    name.send_keys("lap_1", Keys.ENTER)
    control.wait_for_text("notices", "done")
    assert requested(still_dispatcher) == [("save_map", {"name": "lap_1"})]


def test_a_reset_asks_first_and_a_question_waits_for_the_answer_to_the_one_before(control, still_dispatcher):
    control.run(
        "const press = (name) => document.getElementById(name).click();"
        "press('do-reset_map'); window.once = Promise.resolve().then(() => {"
        "  press('confirm-no'); press('do-reset_map'); });"
    )  # asked again before the browser reports the answer
    control.answer()
    control.wait_for_text("notices", "Reset map: done.")
    assert requested(still_dispatcher) == [("reset_map", {})]


def put_health(page, mapping, recording="stopped"):
    """mapping    values of that status; recording: the state of that one"""
    page.run(
        "const status = (name, values) => ({name, level: 0, message: 'ok', since_s: 0, values});"
        "corridor.connection.on.health({stamp_s: 1, latency_ms: {}, statuses: ["
        " status('mapping', arguments[0]), status('recording', {state: arguments[1]}),"
        " status('map', {folder: '/m/office'})]})",
        {"profile": "corridor", **mapping},
        recording,
    )


def test_what_another_profile_refuses_is_disabled_with_the_reason(control):
    for profile, may in (("contour_lm", False), ("corridor", True)):
        put_health(control, {"state": "lost", "profile": profile})
        control.choose("control")
        enabled = [control.element(name).is_enabled() for name in ("do-set_mode", "do-set_pose")]
        assert enabled == [may, may]
        assert ("contour_lm takes no pose" in control.text("pose-words")) is not may
        control.choose("edit")
        assert control.element("draw-wall").is_enabled() is may
        assert ("contour_lm changes no map" in control.text("edit-note")) is not may


def test_the_vehicle_is_only_localised_and_maps_again_by_one_click_each(control, still_dispatcher):
    for mode, wanted in (("mapping", "localization"), ("localization", "mapping")):
        put_health(control, {"state": "ok", "mode": mode})
        control.choose("control")
        control.element("do-set_mode").click()
        control.wait_for_answers()
        assert requested(still_dispatcher)[-1] == ("set_mode", {"mode": wanted})
    control.choose("edit")
    assert not control.element("draw-wall").is_enabled()
    assert "choose Map again under Control" in control.text("edit-note")


def test_cards_without_a_command_and_resources_without_a_store_are_not_shown(still):
    still.run("corridor.connection.on.hello({run_id: '', vehicle: 'v', verbs: ['map_edit'], stores: false})")
    still.choose("control")
    titles = "[...document.querySelectorAll('#control h2')].filter((title) => title.offsetParent)"
    assert still.run(f"return {titles}.map((title) => title.firstChild.textContent)") == ["Access"]
    assert not still.element("tab-resources").is_displayed()


def test_the_pose_of_a_lost_vehicle_is_set_by_dragging(control, still_dispatcher):
    put_health(control, {"state": "ok"})
    assert not control.element("do-set_pose").is_enabled()
    assert control.text("pose-words") == "The pose is known. It can be set while the vehicle is lost."
    put_health(control, {"state": "lost"})
    control.look_at(1.0, 2.0, 40.0)
    control.element("do-set_pose").click()
    control.pointer().drag_and_drop_by_offset(control.element("map"), 0, -60).perform()
    control.wait_for_text("notices", "done.")
    ((verb, request),) = requested(still_dispatcher)
    assert verb == "set_pose"
    assert request == pytest.approx({"x_m": 1.0, "y_m": 2.0, "theta_rad": 1.5707963}, abs=0.03)
    assert control.presses() == 3
