"""The area History: figures, states and events over time, of a running service and of a recording."""

import pytest

from tests.browser.scene import event
from tests.browser.test_past import past, recording  # noqa: F401 - fixtures
from tests.service.offline.past.past_recordings import DEGRADED_S, MARK_S, RESET_S

LINES = "[...document.querySelectorAll('.timeline .line')]"


@pytest.fixture
def history(past):  # noqa: F811
    past.wait_for("return corridor.report().rows > 5")
    past.choose("history")
    return past


def headings(page):
    return page.run(
        "return Object.fromEntries([...document.querySelectorAll('#history .card')].filter((c) => !c.hidden)"
        ".map((card) => card.querySelector('h2')).map((h) => [h.firstChild.data, h.lastChild.textContent]))"
    )


def test_a_recording_shows_the_figures_of_all_of_it(history):
    rows = history.run("return corridor.history.series.rows")
    assert len(rows) >= 19
    assert {row["figures"].get("inlier_ratio") for row in rows[1:]} == {0.93}
    assert {row["figures"]["speed_mps"] for row in rows[1:17]} == {1.0}
    assert rows[-1]["figures"].get("speed_mps") is None  # no pose came any more
    assert set(headings(history)) == {
        *("States and events", "Speed", "Sigma of the position", "Inlier ratio"),
        *("From a scan to its pose", "Rates", "Scans not mapped"),
    }


def test_states_and_events_are_listed_and_a_click_goes_there(history):
    history.wait_for(f"return {LINES}.length >= 5")
    assert history.texts(".timeline .line > :last-child") == [
        "map reset",
        "ok",
        "degraded, 0:02 min",
        "mark, a door",
        "ok, 0:06 min",
    ]
    for words, seconds in (("degraded", DEGRADED_S[0]), ("mark", MARK_S), ("map reset", RESET_S)):
        history.run(f"{LINES}.find((line) => line.textContent.includes(arguments[0])).click()", words)
        history.wait_for(
            "return Math.abs(corridor.report().moment.position_s - arguments[0]) < 0.02", seconds
        )
        assert history.element("history").is_displayed()


def test_a_click_on_a_plot_goes_to_that_moment_and_marks_it(history):
    plot = history.driver.find_elements("css selector", "#history .plot:not(.band)")[0]
    history.run("arguments[0].scrollIntoView({block: 'center'})", plot)
    history.pointer().move_to_element(plot).click().perform()
    history.wait_for("return Math.abs(corridor.report().moment.position_s - 10) < 2")
    marked = history.run("return corridor.history.marked_s - corridor.past.moment.at_s")
    assert abs(marked) < 0.02


def test_a_running_service_adds_a_row_a_second_and_a_click_pins_the_figures_of_then(page, live, scene):
    page.choose("history")
    for seconds in (2.0, 3.0):
        for message in scene.messages(seconds):
            live.put(message)
        page.wait_for("return corridor.report().rows === arguments[0]", seconds - 1)
    for message in scene.messages(4.0, "lost", "no wall in sight"):
        live.put(message)
    live.put(event('{"event": "mark", "text": "<i>door</i>"}', 4.0))
    page.wait_for("return corridor.report().rows === 3")
    page.wait_for_text("history", "mark, <i>door</i>")
    assert page.texts(".timeline .line > :last-child") == ["lost", "mark, <i>door</i>", "ok, 0:02 min"]
    assert headings(page)["Rates"] == "front 50.0 Hz, rear 0.0 Hz"
    assert headings(page)["Sigma of the position"] == "0.021 m"
    page.run(f"{LINES}.at(-1).click()")
    pinned = page.run("return corridor.history.marked_s")
    for message in scene.messages(5.0):
        live.put(message)
    page.wait_for("return corridor.report().rows === 4")
    assert page.run("return corridor.history.marked_s") == pinned
    assert page.faults() == []


def test_axe_finds_nothing_serious_in_the_area_history(axe, history):
    axe(history, "history")
