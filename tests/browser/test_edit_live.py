"""The map of a running session is changed on the page; a back end makes the changes as in the service."""

import json
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.polygons import is_inside
from service.mapper.edit_requests import EDIT_MAP
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapstore.files import save_map
from service.publishing.commands import Answer
from service.web.jobs import ResourceError, SessionMapProcess
from tests.browser.conftest import PHONE, begin_live
from tests.browser.test_edit import drag_map, residuals_m
from tests.service.offline.maps.bent_maps import graph_in

VERBS = ["save_map", "edit_map"]
ERASED = np.array([(9.9, 9.5), (11.6, 9.9)])  # corners of a rectangle about a cabinet, m, map frame


@dataclass
class Mapping:
    """The graph of a running session, and its map as it is saved."""

    back_end: LoopBackEnd
    tiles: list
    folder: Path
    requested: list[tuple[str, dict]] = field(default_factory=list)
    fault: str = ""  # of save_map

    def answer(self, verb: str, payload: bytes) -> Answer:
        request = json.loads(payload)
        self.requested.append((verb, request))
        if verb == "save_map" and self.fault:
            return answer_of(ok=False, error=self.fault)
        if verb == "save_map":
            return answer_of(ok=True, folder=str(self.save()))
        change = EDIT_MAP.validate_json(payload).change
        edited = self.back_end.work(Batch([], "edit_map", change=change)).edited
        return answer_of(ok=False, error=edited.error) if edited.error else answer_of(ok=True, **edited.reply)

    def save(self) -> Path:
        graph = self.back_end.work(Batch([], "checkpoint")).saved
        save_map(self.folder, self.tiles, time.time_ns(), graph=graph)
        return self.folder

    def graph(self):
        return graph_in(self.save())


def answer_of(**body) -> Answer:
    return Answer(body["ok"], json.dumps(body).encode())


@pytest.fixture(scope="module")
def map_process():
    """Looks at the maps of all sessions. It is started here, by a request for a map that is not there: at its
    low priority a start may take longer than a page is waited for.
    """
    process = SessionMapProcess()
    with suppress(ResourceError):
        process.ask("look", Path("none"), {})
    yield SimpleNamespace(ask=process.ask, close=lambda: None)
    process.close()


@pytest.fixture
def mapping(bent, tmp_path):
    return mapping_of(bent.graph, bent.tiles, tmp_path)


def mapping_of(graph, tiles, folder):
    shown = OccupancyTiles(OccupancyConfig(), 0.05)
    return Mapping(LoopBackEnd(LoopsConfig(), shown.renderer, graph), tiles, folder / "maps" / "ring")


@pytest.fixture
def session(page, serve, scene, mapping, map_process, monkeypatch):
    """A running session, open with the token at its area Edit."""
    monkeypatch.setattr("service.web.resources.SessionMapProcess", lambda: map_process)
    maps = mapping.folder.parent
    server = serve(folders={"session": maps / "none", "map": maps})
    monkeypatch.setattr(server, "_answer", mapping.answer)
    begin_live(server, scene, page, verbs=VERBS)
    page.choose("edit")
    return server


def points_within(graph):
    """Of the rectangle."""
    (x0, y0), (x1, y1) = ERASED
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    of = np.repeat(np.arange(len(graph)), graph.point_count)
    return int(is_inside(se2.points_from(graph.map[of], graph.xy_base.astype(np.float64)), corners).sum())


def test_an_area_is_erased_by_three_presses_and_brought_back(page, session, mapping):
    before = points_within(mapping.graph())
    assert before > 50
    page.count_presses()
    page.choose("edit")
    page.look_at(*ERASED.mean(axis=0), 100.0)
    page.element("draw-rectangle").click()
    drag_map(page, *ERASED)
    wait_for_change(page, "erased 0.6")
    assert page.presses() == 3
    assert points_within(mapping.graph()) == 0
    assert [verb for verb, _ in mapping.requested] == ["edit_map"]
    assert mapping.requested[0][1]["change"]["becomes"] == "as_seen"
    page.element("edit-undo").click()
    wait_for_change(page, "took back: erased")
    assert points_within(mapping.graph()) == before
    assert not page.element("edit-undo").is_enabled()
    page.run("corridor.edit.change({what: 'undo'}, 'Undo')")
    wait_for_change(page, "Undo: no change of this session is left to take back")
    page.wait_for("return !corridor.edit.all.disabled")


def titles(page):
    return page.run(
        "return [...document.querySelectorAll('#edit h2')].filter((title) => title.offsetParent)"
        ".map((title) => title.firstChild.textContent)"
    )


def fetch(page, bent):
    page.element("fetch-keyframes").click()
    wait_for_change(page, f"Fetched: {len(bent.graph)} key frames")


def test_places_and_times_are_offered_while_there_are_key_frames(page, session, mapping, bent):
    assert titles(page) == ["Key frames", "Erase and draw"]
    fetch(page, bent)
    assert titles(page) == ["Key frames", "Join places by points", "Erase and draw", "Cut out a time span"]
    mapping.fault = "the disk is full"
    page.run("corridor.edit.change({what: 'optimize'}, 'Optimise')")
    wait_for_change(page, "its key frames could not be fetched: the disk is full")
    assert page.text("edit-note").startswith("Optimise: optimised; key frames moved by up to")
    assert titles(page) == ["Key frames", "Erase and draw"]
    page.run("corridor.connection.on.verbs({verbs: ['save_map', 'set_pose']})")
    assert not page.element("tab-edit").is_displayed()


def test_two_passes_that_lie_apart_are_joined_by_five_presses(page, session, mapping, bent):
    assert bent.error_m(mapping.graph()) > 0.5
    page.count_presses()
    page.choose("edit")
    fetch(page, bent)
    page.driver.find_element("css selector", "#passes button").click()
    page.wait_for("return corridor.edit.pairs.pairs.length === 3")
    page.element("optimise").click()
    page.wait_for("return document.getElementById('confirm').open")
    far = [f"New {k}: {apart_m:.3f} m" for k, apart_m in enumerate(residuals_m(page), 1) if apart_m > 0.5]
    assert far
    assert f": {', '.join(far)}." in page.text("confirm-text")
    page.answer()
    wait_for_change(page, "pairs 0 to 2; key frames moved by up to ")
    assert bent.error_m(mapping.graph()) < 0.10
    assert max(residuals_m(page)) < 0.05
    assert page.element("show-before").is_displayed()
    assert page.presses() == 5
    assert page.run("return corridor.edit.pairs.passes.length") == 0


def test_a_time_span_is_cut_out_while_the_session_runs(page, session, mapping, bent):
    fetch(page, bent)
    page.element("cut-from").send_keys("3")
    page.element("cut-to").send_keys("4")
    assert page.text("cut-words") == "In it: 11 key frames."
    page.element("cut-bridge").click()
    page.element("cut").click()
    page.answer()
    wait_for_change(page, "cut 11 key frames out")
    assert int((mapping.graph().point_count == 0).sum()) == 11


def wait_for_change(page, words):
    """Until the note has these words, or is a refusal."""
    page.wait_for(
        "const note = document.getElementById('edit-note');"
        "return note.dataset.level === 'error' || note.textContent.includes(arguments[0])",
        words,
    )
    assert words in page.text("edit-note")


def test_it_fits_a_phone_and_passes_axe(axe, page, session, bent):
    fetch(page, bent)
    axe(page, "edit", sizes=[PHONE])
