"""The map of a running session is changed on the page: a copy is saved, changed and loaded."""

import json
import math
import shutil
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from selenium.webdriver.support.ui import WebDriverWait

from service.mapstore.files import load_map
from service.offline.map_log import map_log
from service.publishing.commands import Answer
from service.web.work import SessionMapProcess
from tests.browser.conftest import PHONE
from tests.browser.test_edit import EDITED_WITHIN_S, PAIRED, pick_pairs, residuals_m
from tests.browser.test_page import asked, serious_faults
from tests.in_background import in_background
from tests.service.offline.bent_maps import graph_in
from tests.service.web.conftest import TOKEN

VERBS = "['save_map', 'load_map', 'set_pose']"
ERASED = [(10.5, 4.0), (13.5, 8.0)]  # corners of a rectangle, m, map frame
BEFORE_S, SINCE_S = 1.0, 2.0  # of the scene: the last pose in the map before, and the first in the copy


@pytest.fixture
def maps(tmp_path, folder):
    """What a session has stored, to be copied."""
    (tmp_path / "maps").mkdir()
    return tmp_path / "maps"


@pytest.fixture(scope="module")
def map_process():
    """Works on the maps of all sessions: a start of one takes more than a second of processor."""
    process = SessionMapProcess()
    yield SimpleNamespace(ask=process.ask, close=lambda: None)
    process.close()


@pytest.fixture
def session(page, serve, scene, dispatcher, folder, maps, map_process, monkeypatch):
    """A running session, open with the token at its area Edit; its map is that of `folder`."""
    monkeypatch.setattr("service.web.resources.SessionMapProcess", lambda: map_process)
    server = serve(folders={"session": maps / "none", "map": maps})
    poses, poses_come = {"told": scene.messages(BEFORE_S)[1]}, threading.Lock()

    def answer(verb, payload):
        dispatcher.asked.append((verb, payload))
        request = json.loads(payload)
        told = {"ok": True}
        if verb == "save_map":
            stored = maps / request.get("name", "ring")
            shutil.copytree(folder, stored, symlinks=True, dirs_exist_ok=True)
            told["folder"] = str(stored)
        if verb == "load_map":
            told["folder_before"] = f"/maps/before {request['map'].split('/')[-1]}"
            with poses_come:
                scene.store.begin_anew()
                scene.map_all()
                poses["told"] = scene.messages(SINCE_S)[1]
        return Answer(True, json.dumps(told).encode())

    monkeypatch.setattr(server, "_answer", answer)
    for message in scene.messages(BEFORE_S):
        server.put(message)
    page.open(server.address, TOKEN)
    page.wait_for("const r = corridor.report(); return r.mayControl && r.pose && r.tiles > 0")
    page.run(f"corridor.connection.on.verbs({{verbs: {VERBS}}})")
    page.run("corridor.view.isHeld = true")  # a pose that comes late on a busy machine is of now, too
    page.choose("edit")

    def drive(ended):
        while not ended.wait(0.1):
            with poses_come:
                server.put(poses["told"])

    with in_background(drive):
        yield server


def erase_by_mouse(page):
    """A rectangle is drawn on the map, and the question answered."""
    (x0, y0), (x1, y1) = ERASED
    page.look_at((x0 + x1) / 2, (y0 + y1) / 2, 40.0)
    page.element("draw-rectangle").click()
    page.run(
        "const map = document.getElementById('map'), box = map.getBoundingClientRect();"
        "for (const [kind, at] of [['pointerdown', [arguments[0], arguments[1]]],"
        " ['pointermove', [arguments[2], arguments[3]]], ['pointerup', [arguments[2], arguments[3]]]]) {"
        "const [x, y] = corridor.view.camera.toScreen(...at);"
        "map.dispatchEvent(new PointerEvent(kind, {pointerId: 1, button: 0, buttons: 1, bubbles: true,"
        " clientX: box.x + x, clientY: box.y + y})); }",
        x0, y0, x1, y1,
    )  # fmt: skip
    page.wait_for("return document.getElementById('confirm').open")
    page.element("confirm-yes").click()


def test_an_area_is_erased_in_a_copy_in_which_the_mapping_goes_on(
    page, session, dispatcher, scene, folder, maps
):
    erase_by_mouse(page)
    wait_for_change(page, "the mapping goes on in edited-")
    (saved, name), (loaded, copy), (posed, pose) = asked(dispatcher)
    assert (saved, loaded, posed) == ("save_map", "load_map", "set_pose")
    assert copy == {"map": name["name"]}
    newest = map_log(maps / copy["map"])["versions"][-1]
    assert newest["what"] == "erase"
    assert occupied(load_map(maps / copy["map"])) < occupied(load_map(folder))
    there = scene.pose(BEFORE_S) @ scene.pose(SINCE_S)
    assert (pose["x_m"], pose["y_m"]) == pytest.approx((there.x_m, there.y_m))
    assert math.remainder(pose["theta_rad"] - there.theta_rad, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    page.element("edit-undo").click()
    page.element("confirm-yes").click()
    wait_for_change(page, "the mapping goes on in the map before")
    assert asked(dispatcher)[3] == ("load_map", {"map": f"/maps/before {copy['map']}"})


def test_a_pose_of_the_map_before_that_comes_late_is_not_taken_for_one_of_the_copy(page, session, scene):
    """It may be on its way while the answer to load_map overtakes it."""
    page.run(
        "const {live} = corridor.edit, pose = {x_m: 0, y_m: 0, theta_rad: 0}; window.asked = [];"
        "live.lastPose = () => ({x_m: 5, y_m: 1, theta_rad: 0}); live.putPose = () => {};"
        "live.connection = {command: async (...told) => { asked.push(told); return {ok: true}; }};"
        "live.before = 'ring'; const put = Object.getPrototypeOf(live).putPose.bind(live);"
        "const undone = live.undo();"
        "put({...pose, x_m: 9}); live.mapBegan(); put({...pose, x_m: 2}); put({...pose, x_m: 3});"
        "undone.then(() => { window.isDone = true; });"
    )
    page.wait_for("return window.isDone")
    loaded, posed = page.run("return asked")
    assert loaded == ["load_map", {"map": "ring"}]
    assert posed == ["set_pose", {"x_m": 7, "y_m": 1, "theta_rad": 0}]


def occupied(stored):
    """Cells of a wall within the rectangle."""
    (x0, y0), (x1, y1) = ERASED
    count = 0
    for tile in stored.tiles:
        rows, columns = np.nonzero(tile.cells > 50)
        x_m = (tile.ix * tile.cells.shape[1] + columns + 0.5) * tile.cell_m
        y_m = (tile.iy * tile.cells.shape[0] + rows + 0.5) * tile.cell_m
        count += int(((x_m > x0) & (x_m < x1) & (y_m > y0) & (y_m < y1)).sum())
    return count


def test_a_change_that_is_refused_leaves_the_session_as_it_was(page, session, dispatcher):
    page.run("corridor.edit.change({what: 'erase', corners: [[0, 0], [1, 0], [2, 0]], free: false}, 'Erase')")
    wait_for_change(page, "no area")
    assert "the map of the session is as it was" in page.text("edit-note")
    assert [verb for verb, _ in asked(dispatcher)] == ["save_map"]
    page.wait_for("return !corridor.edit.all.disabled")


def titles(page):
    return page.run(
        "return [...document.querySelectorAll('#edit h2')].filter((title) => title.offsetParent)"
        ".map((title) => title.firstChild.textContent)"
    )


def fetch(page, bent):
    page.element("fetch-keyframes").click()
    wait_for_change(page, f"Fetched: {len(bent.graph)} key frames")


def test_places_and_times_are_offered_once_key_frames_are_fetched(page, session, bent):
    assert titles(page) == ["Key frames", "Erase and draw"]
    fetch(page, bent)
    assert titles(page) == ["Key frames", "Join places by points", "Erase and draw", "Cut out a time span"]
    assert not page.element("edit-undo").is_enabled()
    page.run("corridor.connection.on.verbs({verbs: ['save_map', 'set_pose']})")
    assert not page.element("tab-edit").is_displayed()


def test_a_bent_map_is_straightened_while_the_session_runs(page, session, dispatcher, folder, maps, bent):
    fetch(page, bent)
    pick_pairs(page, bent, PAIRED[0])
    page.element("optimise").click()
    wait_for_change(page, "the mapping goes on in edited-")
    copy = next(request["map"] for verb, request in asked(dispatcher) if verb == "load_map")
    assert bent.error_m(graph_in(folder)) > 0.5
    assert bent.error_m(graph_in(maps / copy)) < 0.10
    assert len(residuals_m(page)) == 3
    assert max(residuals_m(page)) < 0.05
    assert page.element("show-before").is_displayed()
    assert page.faults() == []


def test_a_time_span_is_cut_out_while_the_session_runs(page, session, dispatcher, maps, bent):
    fetch(page, bent)
    page.element("cut-from").send_keys("3")
    page.element("cut-to").send_keys("4")
    assert page.text("cut-words") == "In it: 11 key frames."
    page.element("cut-bridge").click()
    page.element("cut").click()
    page.wait_for("return document.getElementById('confirm').open")
    assert "loses what was mapped since" in page.text("confirm-text")
    page.element("confirm-yes").click()
    wait_for_change(page, "the mapping goes on in edited-")
    copy = next(request["map"] for verb, request in asked(dispatcher) if verb == "load_map")
    assert len(graph_in(maps / copy)) == len(bent.graph) - 11
    page.wait_for("return corridor.edit.keyframes.count === arguments[0]", len(bent.graph) - 11)


def wait_for_change(page, words):
    """Until that is said of it, or that it is refused; a process for it may have to be started."""
    WebDriverWait(page.driver, EDITED_WITHIN_S).until(
        lambda driver: driver.execute_script(
            "const note = document.getElementById('edit-note');"
            "return note.dataset.level === 'error' || note.textContent.includes(arguments[0])",
            words,
        )
    )
    assert words in page.text("edit-note")


def test_it_fits_a_phone_and_passes_axe(axe, page, session, bent):
    fetch(page, bent)
    page.run(axe)
    for is_dark in (False, True):
        page.resize(PHONE, is_dark)
        page.choose("edit")
        assert page.run("return document.documentElement.scrollWidth") <= PHONE[0]
        assert serious_faults(page) == [], f"dark: {is_dark}"
