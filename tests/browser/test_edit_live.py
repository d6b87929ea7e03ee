"""The map of a running session is changed on the page: a copy is saved, changed and loaded."""

import json
import math
import shutil

import numpy as np
import pytest

from service.mapstore.files import load_map
from service.offline.map_log import map_log
from service.publishing.commands import Answer
from tests.browser.conftest import PHONE
from tests.browser.test_page import serious_faults
from tests.in_background import in_background
from tests.service.web.conftest import TOKEN

VERBS = "['save_map', 'load_map', 'set_pose']"
ERASED = [(10.5, 4.0), (13.5, 8.0)]  # corners of a rectangle, m, map frame
BEFORE_S, SINCE_S = (
    1.0,
    2.0,
)  # seconds of the scene: the last pose in the map before, and the first in the copy


@pytest.fixture
def maps(tmp_path, folder):
    """What a session has stored, to be copied."""
    (tmp_path / "maps").mkdir()
    return tmp_path / "maps"


@pytest.fixture
def session(page, serve, scene, desk, folder, maps, monkeypatch):
    """A running session, open with the token at its area Edit; its map is that of `folder`."""
    server = serve(folders={"session": maps / "none", "map": maps})
    poses = {"told": scene.messages(BEFORE_S)[1]}

    def answer(verb, payload):
        desk.asked.append((verb, payload))
        request = json.loads(payload)
        if verb == "save_map":
            shutil.copytree(folder, maps / request["name"], symlinks=True)
        told = {"ok": True}
        if verb == "load_map":
            told["folder_before"] = "/maps/ring"
            poses["told"] = scene.messages(SINCE_S)[1]
        return Answer(True, json.dumps(told).encode())

    monkeypatch.setattr(server, "_answer", answer)
    for message in scene.messages(BEFORE_S):
        server.put(message)
    page.open(server.address, TOKEN)
    page.wait_for("const r = corridor.report(); return r.mayControl && r.pose && r.tiles > 0")
    page.run(f"corridor.connection.on.verbs({{verbs: {VERBS}}})")
    page.choose("edit")

    def drive(ended):  # a pose older than 1.5 s is not of now
        while not ended.wait(0.1):
            server.put(poses["told"])

    with in_background(drive):
        yield server


def asked(desk):
    return [(verb, json.loads(payload)) for verb, payload in desk.asked]


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


def test_an_area_is_erased_in_a_copy_in_which_the_mapping_goes_on(page, session, desk, scene, folder, maps):
    erase_by_mouse(page)
    page.wait_for_text("edit-note", "the mapping goes on in edited-")
    (saved, name), (loaded, copy), (posed, pose) = asked(desk)
    assert (saved, loaded, posed) == ("save_map", "load_map", "set_pose")
    assert copy == {"map": name["name"]}
    newest = map_log(maps / copy["map"])["versions"][-1]
    assert newest["what"] == "erase"
    assert occupied(load_map(maps / copy["map"])) < occupied(load_map(folder))
    there = scene.pose(BEFORE_S) @ scene.pose(SINCE_S)
    assert (pose["x_m"], pose["y_m"]) == pytest.approx((there.x_m, there.y_m))
    assert math.remainder(pose["theta_rad"] - there.theta_rad, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    page.driver.find_element("xpath", "//div[@id='notices']//button[text()='Undo the change']").click()
    page.wait_for_text("notices", "The change is undone")
    assert asked(desk)[3] == ("load_map", {"map": "/maps/ring"})


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


def test_a_change_that_is_refused_leaves_the_session_as_it_was(page, session, desk):
    page.run("corridor.edit.change({what: 'erase', corners: [[0, 0], [1, 0], [2, 0]], free: false}, 'Erase')")
    page.wait_for_text("edit-note", "no area")
    assert "the map of the session is as it was" in page.text("edit-note")
    assert [verb for verb, _ in asked(desk)] == ["save_map"]
    page.wait_for("return !corridor.edit.all.disabled")


def test_only_areas_and_walls_are_offered_and_only_where_a_map_can_be_loaded(page, session):
    shown = page.run(
        "return [...document.querySelectorAll('#edit h2')].filter((title) => title.offsetParent)"
        ".map((title) => title.textContent)"
    )
    assert shown == ["Erase and draw"]
    assert not page.element("edit-undo").is_displayed()
    page.run("corridor.connection.on.verbs({verbs: ['save_map', 'set_pose']})")
    assert not page.element("tab-edit").is_displayed()


@pytest.mark.parametrize("is_dark", [False, True])
def test_it_fits_a_phone_and_passes_axe(page, session, axe, is_dark):
    page.resize(PHONE, is_dark)
    page.choose("edit")
    assert page.run("return document.documentElement.scrollWidth") <= PHONE[0]
    page.run(axe)
    assert serious_faults(page) == []
