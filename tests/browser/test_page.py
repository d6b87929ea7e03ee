import json
from dataclasses import replace

import numpy as np
import pytest
from selenium.webdriver.common.keys import Keys

from drivers.frames import no_distance
from service.encoding import Status, encode_diagnostics, encode_frame, encode_graph
from service.outputs import GraphPicture
from tests.browser.conftest import DESKTOP, PHONE, begin_live, requested
from tests.browser.scene import event, stamp
from tests.service.web.conftest import TOKEN

EVENT_LINES = "return [...document.querySelectorAll('.events li span')].map((line) => line.textContent)"


def health(seconds, *statuses):
    return encode_diagnostics("diagnostics", statuses, stamp(seconds), stamp(seconds))


def name_of(page, sensor):
    return page.driver.find_element("xpath", f"//section[@id='information']//button[contains(., '{sensor}')]")


def test_sensors_and_figures_are_listed_and_a_fault_has_its_words(still):
    rows = still.text("information")
    assert "no route to 192.168.0.10" in rows
    assert "1 of 2 well" in rows
    cells = still.run("return document.querySelector('#information tbody tr').innerText.split(/\\s+/)")
    assert cells == ["front", "50.0", "0.02", "5.0", "0", "2:15", "h"]
    facts = dict(
        still.run(
            "return [...document.querySelectorAll('#information .facts dt')]"
            ".map((name) => [name.textContent, name.nextSibling.textContent])"
        )
    )
    assert facts["Scans mapped a second"] == "50.0"
    assert facts["Scans not mapped"] == "3"
    assert facts["Processor a scan, median"] == "0.9 ms"
    assert "Scans mapped" not in facts  # of a replay only


def test_all_that_a_sensor_tells_is_shown_while_its_name_is_pressed(still):
    name_of(still, "rear").send_keys(Keys.ENTER)
    assert name_of(still, "rear").get_attribute("aria-expanded") == "true"
    shown = still.driver.find_element("css selector", ".details:not([hidden])").text
    assert shown.splitlines()[:3] == ["no route to 192.168.0.10", "state: down", "rate_hz: 0.0"]
    name_of(still, "rear").send_keys(Keys.ENTER)
    assert still.driver.find_elements("css selector", ".details:not([hidden])") == []


@pytest.mark.parametrize(
    ("expression", "words"),
    [
        ("[-0.0004, -0.0006].map((x) => m.fixed(x, 3, ' m'))", ["0.000 m", "-0.001 m"]),  # no zero has a sign
        ("[-0.0001, -0.01].map((x) => m.degrees(x))", ["0.0\u00b0", "-0.6\u00b0"]),
        ("['', '95', '8130', '1.3e6'].map(m.deviceClock)", ["\u2013", "1:35 min", "2:15 h", "15 d"]),
        (
            "['852076800', '1795200000', '4004188800'].map(m.deviceClock)",
            ["1997", "2026", "2026"],
        ),  # last: NTP
        ("[999, 1000, 2.5e6, 7e9].map(m.bytes)", ["999 B", "1.0 kB", "2.5 MB", "7.0 GB"]),
    ],
)
def test_numbers_as_words(still, expression, words):
    assert still.of_module("format.js", expression) == words


def test_the_token_leaves_the_address_bar(still):
    assert still.report()["mayControl"]
    assert TOKEN not in still.driver.current_url
    assert "#" not in still.driver.current_url


def test_everything_can_be_reached_with_the_keyboard_and_tabs_by_arrow_keys(still):
    still.run("document.activeElement.blur(); window.scrollTo(0, 0)")
    reached = []
    for _ in range(30):
        still.pointer().send_keys(Keys.TAB).perform()
        reached.append(still.driver.switch_to.active_element.get_attribute("id"))
    assert {"theme", "map", "follow", "measure", "tab-information", "information"} <= set(reached)
    still.element("tab-information").send_keys(Keys.ARROW_RIGHT)
    assert still.element("control").is_displayed()
    assert not still.element("information").is_displayed()
    assert still.driver.switch_to.active_element.get_attribute("id") == "tab-control"


def test_a_long_name_of_a_file_goes_on_after_an_underscore(still):
    parts = still.run(
        "const name = [...document.querySelectorAll('#information dd')]"
        ".find((node) => node.textContent.startsWith('veh1_'));"
        "return [...name.childNodes].map((node) => node.nodeName === 'WBR' ? '|' : node.data)"
    )
    assert parts == ["veh1_", "|", "20260101T000000Z_", "|", "0001.mcap"]


def test_a_notice_that_comes_again_is_shown_once(still):
    for _ in range(3):
        still.of_module("dom.js", "m.notice('the disk is full', 'error')")
    assert still.texts(".notice span") == ["the disk is full"]
    still.press("Close notice")


def test_the_state_and_its_reason_stand_on_top_and_move_no_figure(page, scene, live):
    assert page.text("state") == "ok"
    where = "return document.querySelector('#information .facts').getBoundingClientRect().top"
    before = page.run(where)
    reason = "front: 40 % of the beams, having waited up to 103 ms, disagree with the map; " * 3
    live.put(scene.messages(2.0, "degraded", reason)[-1])
    page.wait_for_text("state", "degraded")
    assert page.text("reason") == reason
    assert page.element("state").get_attribute("data-level") == "warn"
    live.put(scene.messages(9.0, "degraded", reason)[-1])
    page.wait_for_text("information", "for 0:07 min")
    assert page.run(where) == before


def test_the_scan_of_a_laser_is_shown_in_its_frame_and_beams_without_a_return_are_counted(page, live, scene):
    name_of(page, "front").click()
    scan = scene.scan("front", 1.1)
    range_m = scan.range_m.copy()
    range_m[:40] = np.nan  # on its right
    range_m[40:43] = no_distance("dazzled")
    live.put(encode_frame(replace(scan, range_m=range_m), log_ns=stamp(1.2)))
    page.wait_for_text("information", "361 beams: 318 returns")
    page.wait_for_text("information", "43 without a return")
    assert page.texts(".cause") == ["no return: 40", "dazzled: 3"]
    left, right = page.run(
        "const canvas = document.querySelector('.polar'), {width, height} = canvas, found = [0, 0];"
        "const {data} = canvas.getContext('2d').getImageData(0, 0, width, height);"
        "const warn = getComputedStyle(document.documentElement).getPropertyValue('--warn').trim().slice(1);"
        "const tick = [0, 2, 4].map((k) => parseInt(warn.slice(k, k + 2), 16));"
        "const is = (i) => tick.every((value, k) => Math.abs(data[i + k] - value) < 12);"
        "for (let i = 0; i < data.length; i += 4)"
        " if (data[i + 3] > 200 && is(i)) found[Number((i / 4) % width >= width / 2)] += 1;"
        "return found"
    )
    assert left == 0
    assert right > 40  # beams that look to the right


def test_clocks_of_devices_are_judged_and_long_figures_stay_within_their_card(page, live):
    page.resize(PHONE)
    page.choose("information")
    values = {"rate_hz": "201.7", "age_s": "0.02", "dropped": "12345"}
    clocks = {"front": ("319999999", "0.21"), "rear": ("4004188800", "900.0"), "lux": ("8130", "")}
    rows = [
        Status(f"sensor/{name}", 0, "ok", {**values, "device_clock_s": clock_s, "clock_sigma_ms": sigma_ms})
        for name, (clock_s, sigma_ms) in clocks.items()
    ]
    live.put(health(2.0, *rows))
    page.wait_for_text("information", "3703 d")
    for width in (PHONE[0], 320):
        page.resize((width, PHONE[1]))
        page.wait_for("return innerWidth === arguments[0]", width)
        table, card = page.run(
            "const table = document.querySelector('#information table'), card = table.parentElement;"
            "const padding = parseFloat(getComputedStyle(card).paddingRight);"
            "return [table.getBoundingClientRect().right, card.getBoundingClientRect().right - padding]"
        )
        assert table <= card, width
    for name in ("front", "rear"):
        name_of(page, name).click()
    page.wait_for_text("information", "device clock: 3703 d, runs right (\u00b1 0.2 ms)")
    page.wait_for_text("information", "device clock: 2026, is being learnt (\u00b1 900.0 ms)")


def test_events_are_listed_newest_first_and_one_that_comes_again_within_ten_seconds_stays_one_line(
    page, live
):
    for text, seconds in (
        ("<b>door</b>", 2.0),
        ("lift", 3.0),
        ("<b>door</b>", 8.0),
        ("<b>door</b>", 17.0),
        ("lift", 40.0),
    ):
        live.put(event(json.dumps({"event": "mark", "text": text}), seconds))
    page.wait_for(f"{EVENT_LINES}.filter((line) => line.startsWith('mark')).length === 3")
    expected = ["mark, lift", "mark, <b>door</b> (3 times)", "mark, lift"]  # as text, never as markup
    assert page.run(EVENT_LINES)[:3] == expected
    for share, seconds in ((12, 41.0), (9, 44.0)):
        reason = f"{share} % of the returns lie on the map (expected 45 %)"
        live.put(event(json.dumps({"event": "mapping", "state": "lost", "reason": reason}), seconds))
        live.put(event(json.dumps({"event": "sensor", "sensor": f"lidar{share}", "state": "down"}), seconds))
    page.wait_for(f"{EVENT_LINES}[0] === 'sensor, lidar9, down'")
    assert page.run(EVENT_LINES)[1:3] == [
        "mapping, lost, 9 % of the returns lie on the map (expected 45 %) (2 times)",
        "sensor, lidar12, down",
    ]


def test_without_the_token_one_only_looks(page, serve, scene, dispatcher):
    begin_live(serve(), scene, page, token="")
    page.choose("control")
    page.wait_for("return !document.getElementById('do-mark').hidden")
    assert not page.element("do-mark").is_enabled()
    assert "You may look" in page.text("access-words")
    page.run("return corridor.connection.command('mark', {text: 'x'})")
    assert dispatcher.requested == []
    page.element("token").send_keys("wrong", Keys.ENTER)
    page.wait_for_text("notices", "not the token")
    page.element("token").send_keys(TOKEN, Keys.ENTER)
    page.wait_for_text("access-words", "Unlocked")
    assert page.element("do-mark").is_enabled()


def test_it_comes_back_after_the_service_was_started_again(page, serve, scene, live):
    port = live.address.rstrip("/").rpartition(":")[2]
    before = page.report()["runId"]
    live.close()
    page.wait_for_text("state", "no connection")
    assert page.element("information-old").is_displayed()
    assert "All of this is of" in page.text("information-old")
    scene.store.start_over()
    again = serve(listen=f"127.0.0.1:{port}")
    page.wait_for("const r = corridor.report(); return r.isOpen && r.runId !== arguments[0]", before)
    page.wait_for("const r = corridor.report(); return r.tiles === 0 && r.pathPoints === 0 && r.mayControl")
    assert page.text("state") == "starting"  # how the run before was is nothing of this one
    assert not page.element("information-old").is_displayed()
    assert "front" not in page.text("information")
    again.put(scene.messages(5.0)[1])
    page.wait_for("const p = corridor.report().pose; return p && p.stamp_ns === '1700000005000000000'")


def test_a_session_is_renamed_deleted_and_taken_back(page, serve, tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"a session")
    page.open(serve(folders={"session": tmp_path, "map": tmp_path}).address, TOKEN)
    page.wait_for("return corridor.report().mayControl")
    page.choose("resources")
    page.wait_for_text("resources", "a.mcap")
    page.press("Rename\u2026 a.mcap")
    page.element("confirm-input").send_keys("lap", Keys.ENTER)
    page.wait_for_text("resources", "lap.mcap")
    page.press("Delete\u2026 lap.mcap")
    page.answer()
    page.wait_for_text("notices", "lap.mcap is deleted.")
    assert not (tmp_path / "lap.mcap").exists()
    page.driver.find_element("xpath", "//div[@id='notices']//button[text()='Undo']").click()
    page.wait_for_text("notices", "lap.mcap is back.")
    assert (tmp_path / "lap.mcap").read_bytes() == b"a session"


def test_axe_finds_nothing_serious(axe, page, live):
    for number in range(40):
        live.put(event(f'{{"event": "mark", "text": "{number}"}}', 2.0 + number))
    page.wait_for_text("information", "mark, 39")
    page.choose("information")
    for name in page.driver.find_elements("css selector", "#information button.name"):
        name.click()
    axe(page, "information", "control", "resources")


def test_axe_finds_nothing_serious_in_a_replay_with_its_layers_open(axe, page, live):
    line = np.array([[0.0, 0.0], [2.0, 0.0]], np.float32)
    live.put(encode_graph(GraphPicture(stamp(1.0), [line], line[None], line[None]), stamp(1.0)))
    live.put(replaying(20.0))
    page.wait_for_text("replay-time", "0:20 min")
    page.run("document.querySelector('.layers').open = true")
    page.run("document.getElementById('layer-change').click()")
    page.wait_for("return document.querySelectorAll('.graph-part, .change-part').length === 5")
    axe(page, "information", sizes=[DESKTOP])
    axe(page, "map", sizes=[PHONE])


def replaying(seconds, **values):
    """Health of a replay of 100 s."""
    given = {"state": "replaying", "duration_s": "100.00", "rate": "4", "speed": "3.9", **values}
    return health(seconds, Status("replay", 0, "", {"position_s": f"{seconds:.2f}", **given}))


def test_a_replay_is_steered_from_its_strip(page, live, dispatcher):
    assert not page.element("replay").is_displayed()
    live.put(replaying(20.0))
    page.wait_for_text("replay-time", "0:20 min of 1:40 min")
    assert page.element("replay").is_displayed()
    assert "3.9 times real time" in page.text("replay-note")
    assert page.run("return document.getElementById('replay-rate').selectedOptions[0].text") == "4 times"
    page.element("replay-toggle").click()
    page.element("replay-step").click()
    page.put("replay-rate", "0")
    for seconds, position in (("5", "20"), ("50", "50")):  # it is not dragged back
        page.put("replay-position", seconds)
        assert page.element("replay-position").get_attribute("value") == position
    assert page.text("replay-note") == "forward only"
    live.put(replaying(50.0, state="paused"))
    page.wait_for_text("replay-time", "0:50 min of 1:40 min")
    page.wait_for_text("replay-toggle", "Go on")
    page.run("corridor.view.poseArrived_ms = -1e9")  # long ago
    assert page.run("return corridor.view.isLive")
    page.element("replay-toggle").click()
    page.wait_for_answers()
    assert requested(dispatcher) == [
        ("replay_pause", {}),
        ("replay_go_to", {"position_s": 21}),
        ("replay_rate", {"rate": 0}),
        ("replay_go_to", {"position_s": 50}),
        ("replay_resume", {}),
    ]
    live.put(replaying(100.0, state="finished"))
    page.wait_for_text("replay-note", "finished")
    assert not page.element("replay-toggle").is_enabled()
    assert not page.run("return corridor.view.isLive")


def test_the_path_goes_on_where_a_replay_leaves_poses_out(page, live):
    before = page.report()["pathPoints"]
    live.put_stretch(np.array([[1.0, 1.0], [2.0, 1.0], [3.0, 1.0]], np.float32))
    page.wait_for("return corridor.report().pathPoints === arguments[0]", before + 3)
    live.put_path(np.array([[5.0, 1.0], [6.0, 1.0]], np.float32))
    page.wait_for("return corridor.report().pathPoints === 2")
