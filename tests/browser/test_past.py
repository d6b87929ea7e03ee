"""A recording looked at moment by moment: with the mouse, and with keys alone."""

import numpy as np
import pytest
from selenium.webdriver.common.keys import Keys

from service.offline.past.past_page import RecordingView
from service.offline.past.replay_page import ReplayPage
from service.offline.replay.replay import ReplayOptions, replay
from tests.browser.scene import Scene, stamp
from tests.service.offline.conftest import record_drive  # noqa: F401 - a fixture
from tests.service.offline.past.past_recordings import LASTS_S, write_past

END_S = LASTS_S + 0.005  # the last scan's arrival


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    view = RecordingView(write_past(tmp_path_factory.mktemp("past")), "127.0.0.1:0")
    yield view
    view.close()


@pytest.fixture
def past(share, recording):
    """The recording's page, shared; at its last moment."""

    def open_it(page):
        page.open(recording.address)
        page.wait_for("const r = corridor.report(); return r.moment && r.mayControl && r.health")

    page = share(recording.address, open_it)
    page.element("past-position").send_keys(Keys.END)
    wait_for_moment(page, END_S)
    page.wait_for("return corridor.report().tiles > 0")
    return page


def wait_for_moment(page, seconds, within_s=0.006):
    page.wait_for(
        "const r = corridor.report(); return Math.abs(r.moment.position_s - arguments[0]) < arguments[1]"
        " && Math.abs(r.health.stamp_s - r.moment.at_s) < 1e-6",
        seconds,
        within_s,
    )


def go_to(page, seconds):
    page.put("past-position", str(seconds))
    wait_for_moment(page, seconds)


def test_dragging_the_slider_shows_pose_path_map_and_scans_of_that_moment(past):
    go_to(past, 8.0)
    report = past.report()
    assert report["pose"]["stamp_ns"] == str(stamp(7.9) + 1)
    assert report["pose"]["x_m"] == pytest.approx(Scene().pose(7.9).x_m, abs=1e-6)
    past.wait_for("return corridor.view.tiles.valueAt(3.98, 0.0) === 100")  # the first room's wall
    past.look_at(0.0, 0.0, 30.0)
    past.wait_for("const p = corridor.report().scanPoints; return p.front === 361 && p.rear === 361")
    points = past.run("return [...corridor.view.scans.values()].flatMap(({points}) => [...points])")
    off_walls_m = np.abs(np.abs(np.reshape(points, (-1, 2))) - (8, 5)).min(axis=1)
    assert off_walls_m.max() < 0.02  # of the room that was driven in
    assert past.text("state") == "degraded"
    assert past.text("past-note") == "map recorded 3.0 s before"
    assert past.text("past-time") == f"8.00 of {END_S:.2f} s, 2023-11-14 22:13:28.0 UTC"
    slider = past.element("past-position")
    quarter = round(slider.size["width"] / 4)
    actions = past.pointer().move_to_element_with_offset(slider, quarter, 0).click_and_hold()
    actions.move_to_element_with_offset(slider, -quarter, 0).release().perform()
    wait_for_moment(past, 5.0, within_s=0.7)


def test_it_goes_back_as_well_as_forward(past):
    length = "return corridor.report().moment.path[1] - corridor.report().moment.path[0]"
    go_to(past, 11.0)
    late = past.run(length)
    past.wait_for("return corridor.view.tiles.valueAt(7.98, 0.0) === 100")
    go_to(past, 2.0)
    assert 0 < past.run(length) < 0.3 * late
    past.wait_for("return corridor.report().tiles === 0")  # no map was recorded yet
    assert "mark" not in past.text("information")
    go_to(past, 14.5)
    past.wait_for("return corridor.view.tiles.valueAt(7.98, 0.0) === 100")
    assert "map reset" in past.text("information")
    assert past.run("return corridor.report().moment.path[0]") > 0
    for seconds, sensors, is_live in ((13.5, "front,rear", True), (16.0, "front", True), (19.5, "", False)):
        go_to(past, seconds)  # a laser falls silent, then all do
        past.wait_for(
            "return corridor.view.isLive === arguments[1]"
            " && (!arguments[1] || corridor.report().shownSensors.join() === arguments[0])",
            sensors,
            is_live,
        )
    assert past.report()["pose"]["stamp_ns"] == str(stamp(16.9) + 1)


def test_the_path_is_shown_as_far_as_it_was_driven(past):
    reached, not_yet = Scene().pose(2.0), Scene().pose(4.0)
    past.run("for (const layer of ['scans', 'vehicle', 'map', 'grid']) corridor.view.layers[layer] = false")
    try:
        colours = []
        for seconds in (6.0, 3.0):
            go_to(past, seconds)
            past.look_at(0.0, 0.0, 40.0)
            colours.append([past.pixel(p.x_m, p.y_m) for p in (reached, not_yet)])
    finally:
        past.run("for (const name of Object.keys(corridor.view.layers)) corridor.view.layers[name] = true")
    (path, also_path), (still_path, ground) = colours
    assert path == also_path == still_path != ground


def test_keys_and_buttons_step_and_play_runs_to_the_end_and_begins_again(past):
    for name, keys, seconds in (
        ("past-position", (Keys.ARROW_LEFT,), END_S - 1.0),
        ("past-position", (Keys.ARROW_RIGHT,), END_S),
        ("past-position", (Keys.SHIFT, Keys.ARROW_LEFT), END_S - 0.1),
        ("past-position", (Keys.PAGE_DOWN,), END_S - 10.1),
        ("past-position", (Keys.SHIFT, Keys.ARROW_RIGHT), END_S - 10.0),
        ("past-position", (Keys.HOME,), 0.0),
        ("past-position", (Keys.ARROW_LEFT,), 0.0),
        ("map", "..", 2.0),
        ("map", ",", 1.0),
    ):
        past.element(name).send_keys(*keys)
        wait_for_moment(past, seconds)
    assert past.element("past-position").get_attribute("aria-valuetext").startswith("1.00 of")
    for name, seconds in (("past-by10", 11.0), ("past-by-1", 10.0), ("past-by1", 11.0), ("past-by-10", 1.0)):
        past.element(name).click()
        wait_for_moment(past, seconds)
    past.put("past-rate", "50")
    past.element("past-play").click()
    wait_for_moment(past, END_S)
    past.wait_for_text("past-play", "Play")
    past.put("past-rate", "1")
    past.element("past-play").click()
    past.wait_for("const p = corridor.report().moment.position_s; return p > 0 && p < 3")
    past.element("past-play").click()
    assert past.text("past-play") == "Play"


def test_the_newest_wish_counts_and_the_service_is_not_flooded(past):
    past.run(
        "window.asked = []; const ask = corridor.past.ask;"
        "corridor.past.ask = (s) => { window.asked.push(s); return ask(s); };"
        "for (let i = 0; i <= 100; i += 1) corridor.past.go(15 - i / 10)"
    )
    wait_for_moment(past, 5.0)
    asked = past.run("return window.asked")
    assert 1 < len(asked) < 5
    assert asked[-1] == 5


def test_without_the_token_one_sees_the_moment_and_cannot_go_elsewhere(page, recording):
    page.open(recording.address.partition("#")[0])
    page.wait_for("return corridor.report().moment")
    assert page.element("past-position").is_displayed()
    assert not page.element("past-position").is_enabled()
    assert not page.element("past-play").is_enabled()
    before = page.report()["moment"]["position_s"]
    page.element("map").send_keys(",")
    page.wait_for_text("notices", "needs the token")
    assert page.report()["moment"]["position_s"] == before


def test_a_replay_that_is_finished_is_looked_back_at_until_another_begins(page, address, record_drive):  # noqa: F811
    shown = ReplayPage(address, "lap", 0.0)
    try:
        done = replay([record_drive(scans=60)], ReplayOptions(), watch=shown)
        page.open(shown.address)
        page.wait_for(
            "const r = corridor.report(); return r.moment && r.mayControl && r.health && r.tiles > 0"
        )
        assert page.element("past").is_displayed()
        assert not page.element("replay").is_displayed()
        page.element("past-position").send_keys(Keys.HOME)
        page.wait_for("return corridor.report().moment.position_s === 0")
        first_ns = str(done.outputs[0].stamp_ns)
        page.wait_for("return corridor.report().pose.stamp_ns === arguments[0]", first_ns)
        page.element("map").send_keys(".")
        page.wait_for("return Math.abs(corridor.report().moment.position_s - 1) < 0.001")
        page.wait_for("return corridor.report().scanPoints.front > 100")
        assert np.isfinite(page.run("return [...corridor.view.scans.get('front').points]")).all()
        shown._begin_map()
        shown._tell_status()
        page.wait_for("return corridor.view.moment === null")
        assert not page.element("past").is_displayed()
        assert page.report()["pose"] is None
        page.element("map").send_keys(",")  # a running one has no past
        assert page.faults() == []
    finally:
        shown.close()


def test_axe_finds_nothing_serious_on_the_page_of_a_recording(axe, past):
    axe(past, shown="past-note")
