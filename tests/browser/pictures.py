"""Makes the pictures of docs/operator.md and docs/results.md: `python -m tests.browser.pictures`."""

import json
import math
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import chdir, closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drivers.frames import Frame, LaserScan
from service import encoding
from service.geometry.poses import Floats, points_from, points_seen
from service.geometry.se2 import SE2
from service.mapper.profiles import METHODS, build_mapper, mapping_config
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import save_map
from service.mapstore.tiles import TileStore
from service.offline.past.past_page import RecordingView
from service.offline.past.replay_page import ReplayPage
from service.offline.past.view import View
from service.offline.replay.replay import ReplayOptions, write_replay
from service.offline.replay.replay import replay as replay_session
from service.offline.report import REPORT_FILE, write_report
from service.outputs import GraphPicture, Grid, MapperOutput
from service.publishing.commands import Answer
from service.web.config import WebConfig
from service.web.server import About, WebServer
from simulators.truth import LMS100, UTM30LX, Ride
from simulators.worlds import build_world
from tests.browser.conftest import DESKTOP, HEADLESS, PHONE, ROOT, Page, open_view, start_chromium
from tests.browser.scene import event, statuses
from tests.browser.test_edit import choose_places
from tests.in_background import in_background, started
from tests.recorded_drive import record
from tests.service.mapper.graph.loops.rings import HALF_M, LENGTH_M
from tests.service.offline.maps.bent_maps import ROUND, BentMap, bent_map, save_bent
from tests.service.recording.sessions import write_file
from tests.simulated import Laser, Wheels, odometry, scans

IMAGES = ROOT / "docs" / "images"
DRIVEN_S, SHOWN_S = 62.0, 2.0
MAP_PERIOD_NS = 10_000_000_000
UNIX_NS = 1_795_000_000_000_000_000  # of the drive's begin
MOUNTINGS = {"front": SE2(0.2, 0.0, 0.0), "rear": SE2(-0.2, 0.0, math.pi)}
LASERS = (
    Laser(LMS100, 541, 25.0, -135.0, 0.5, MOUNTINGS["front"], "front"),
    Laser(UTM30LX, 1081, 10.0, -135.0, 0.25, MOUNTINGS["rear"], "rear"),
)
VERBS = [
    *("pause", "resume", "save_map", "reset_map", "load_map", "switch_profile"),
    *("start_recording", "stop_recording", "mark", "set_pose", "edit_map", "set_mode"),
]


@contextmanager
def chromium() -> Iterator[Page]:
    driver = start_chromium(HEADLESS)
    try:
        page = Page(driver)
        page.resize(DESKTOP)
        yield page
    finally:
        driver.quit()


class Office(NamedTuple):
    """A drive through it."""

    frames: list[Frame]  # as they arrived
    outputs: list[MapperOutput]
    graph: GraphPicture
    saved: SavedGraph  # with which mapping could go on
    maps: list[tuple[int, Grid]]  # by the time, ns, at which each was whole

    @property
    def seen(self) -> list[LaserScan]:
        return [frame for frame in self.frames if isinstance(frame, LaserScan)]


def map_office(store: TileStore) -> Office:
    ride = Ride(build_world("office"), 0, 0.5)
    frames = [scan for laser in LASERS for scan in scans(ride, laser, DRIVEN_S, [1])[0]]
    frames += odometry(ride, Wheels(), DRIVEN_S, 1)
    mapper = build_mapper(mapping_config({}), MOUNTINGS)
    outputs: list[MapperOutput] = []
    maps: list[tuple[int, Grid]] = []
    frames.sort(key=lambda frame: frame.arrived_ns)
    for frame in frames:
        if (output := mapper.process(frame)) is not None:
            outputs.append(output)
        if frame.arrived_ns >= (len(maps) + 1) * MAP_PERIOD_NS:
            store.update(mapper.changed_tiles())
            grid = store.grid()
            assert grid is not None
            maps.append((frame.arrived_ns, grid))
    saved = mapper.finish().update.saved
    store.update(mapper.changed_tiles())
    assert mapper.graph_picture is not None
    assert isinstance(saved, SavedGraph)
    return Office(frames, outputs, mapper.graph_picture, saved, maps)


def take_replay(page: Page, frames: Sequence[Frame], folder: Path) -> None:
    """Half of the drive replayed, and halted there."""
    shown = ReplayPage("127.0.0.1:0", "veh1", 0.0, is_paused=True)
    session = record(frames, MOUNTINGS, folder, UNIX_NS)
    working = started(lambda: replay_session([session], ReplayOptions(), watch=shown))
    try:
        page.driver.get(shown.address)
        page.wait_for("return window.corridor && corridor.report().mayControl && corridor.report().health")
        page.run("corridor.connection.command('replay_go_to', {position_s: arguments[0]})", 0.55 * DRIVEN_S)
        page.wait_for_text("replay-time", "0:34 min")
        page.wait_for_text("replay-note", "paused")
        page.wait_for("return corridor.report().tiles > 0 && corridor.report().pose")
        page.resize(DESKTOP)
        page.element("fit").click()
        save_picture(page, "replay")
        page.resize(DESKTOP, is_dark=True)
        switch_layers(page, "standing", "scans")
        pose = page.report()["pose"]
        page.look_at(pose["x_m"], pose["y_m"] + 1.0, 42.0)
        save_picture(page, "static")
        page.resize(DESKTOP)
    finally:
        page.run("return corridor.connection.command('replay_resume')")
        working.result()
        shown.close()


def take_report(page: Page, frames: Sequence[Frame], folder: Path) -> None:
    """The page that corridor report makes of the drive."""
    session, result = record(frames, MOUNTINGS, folder, UNIX_NS), folder / "result"
    write_replay(replay_session([session], ReplayOptions()), result)
    write_report(result, result / REPORT_FILE)
    page.driver.get((result / REPORT_FILE).as_uri())
    for name, is_dark in (("light", False), ("dark", True)):
        page.resize((1200, 1500), is_dark)
        page.run("document.documentElement.style.scrollbarWidth = 'none'")
        page.driver.save_screenshot(str(IMAGES / f"report-{name}.png"))


def take_past(page: Page, office: Office, folder: Path) -> None:
    """The drive as a service would have recorded it, at one of its moments."""
    messages = [encoding.encode_tf_static(MOUNTINGS, UNIX_NS, UNIX_NS)]
    for scan in office.seen:
        moved = replace(scan, stamp_ns=scan.stamp_ns + UNIX_NS, arrived_ns=scan.arrived_ns + UNIX_NS)
        messages.append(encoding.encode_frame(moved))
    messages += [
        encoding.encode_pose(replace(o, stamp_ns=o.stamp_ns + UNIX_NS), o.stamp_ns + UNIX_NS + 45_000_000)
        for o in office.outputs
    ]
    messages += [encoding.encode_grid(grid, at_ns + UNIX_NS, at_ns + UNIX_NS) for at_ns, grid in office.maps]
    messages += [
        health(UNIX_NS + k * 10**9, "degraded" if 20 < k < 26 else "ok") for k in range(round(DRIVEN_S))
    ]
    for seconds, text in ((8.0, "door to the store room is open"), (41.0, "pallet in the corridor")):
        at_ns = UNIX_NS + round(seconds * 1e9)
        messages.append(encoding.encode_event(json.dumps({"event": "mark", "text": text}), at_ns, at_ns))
    write_file(folder / "veh1_20261118T061320Z_0001.mcap", sorted(messages, key=lambda m: m.log_ns))
    view = RecordingView([folder / "veh1_20261118T061320Z_0001.mcap"], "127.0.0.1:0")
    try:
        page.open(view.address)
        page.wait_for("return corridor.report().moment && corridor.report().mayControl")
        page.resize(DESKTOP)
        page.run("corridor.past.go(arguments[0])", 42.6)
        page.wait_for("return Math.abs(corridor.report().moment.position_s - 42.6) < 0.01")
        page.wait_for("return corridor.report().tiles > 0 && corridor.report().shownSensors.length === 2")
        page.element("fit").click()
        save_picture(page, "past")
        page.choose("history")
        page.wait_for("return document.querySelectorAll('.timeline .line').length > 2")
        save_picture(page, "history")
        page.resize(PHONE, is_dark=True)
        page.choose("history")
        save_picture(page, "history-phone")
        page.resize(DESKTOP)
    finally:
        view.close()


def take_loops(page: Page, stored: Path) -> None:
    """Those of the office, the places of one of them on the map."""
    with edited(page, stored):
        page.run("document.querySelector('.loops button').click()")
        page.wait_for("return corridor.edit.pairs.places.b.points.length > 0")
        page.run("document.querySelector('.loops').closest('.card').scrollIntoView()")
        save_picture(page, "loops")


def take_edit(page: Page, folder: Path) -> None:
    """A ring of corridors whose second round lies beside the first, before it is mended."""
    bent, k = bent_map(), 6
    save_bent(folder, bent)
    with edited(page, folder):
        take_pairs(page, bent, k)
        take_panes(page, bent)


@contextmanager
def edited(page: Page, folder: Path) -> Iterator[None]:
    """Its stored map, open at the area Edit."""
    with (
        chdir(folder.parent),
        closing(View(Path(folder.name), "127.0.0.1:0")) as view,
    ):  # named as it is given
        page.resize(DESKTOP)
        open_view(page, view)
        yield


def take_pairs(page: Page, bent: BentMap, k: int) -> None:
    choose_places(page, k)
    page.look_at(3.2, 0.4, 110.0)
    page.element("pick-pairs").click()
    for number, pair in enumerate(bent.common_points(k)):
        click_at(page, pair[0])
        if number < 2:
            click_at(page, pair[1])
    save_picture(page, "edit-pairs")
    page.element("forget-places").click()


def take_panes(page: Page, bent: BentMap) -> None:
    """A corner of the ring, seen in both rounds."""
    k, corner = 38, np.array([LENGTH_M + HALF_M, -HALF_M])
    corner_2 = corner_of_second_round(bent, k, corner)
    choose_places(page, k)
    page.element("side-by-side").click()
    page.look_at(corner[0] - 1.2, corner[1] + 1.0, 90.0)
    page.run(
        "const {pane} = corridor.edit.pairs; pane.camera.scale = 90;"
        "pane.camera.centreOn(arguments[0], arguments[1]); corridor.edit.tool.click("
        "corridor.view.camera.toScreen(arguments[2], arguments[3])); pane.gestures.onHover("
        "pane.camera.toScreen(arguments[4], arguments[5]))",
        corner_2[0] - 1.2,
        corner_2[1] + 1.0,
        *corner.tolist(),
        *corner_2.tolist(),
    )
    save_picture(page, "edit-panes")
    page.element("forget-places").click()


def corner_of_second_round(bent: BentMap, k: int, xy_map: Floats) -> Floats:
    """Where a point that key frame k sees lies for the one a round later, m."""
    seen = points_seen(bent.truth[k + ROUND], xy_map[None])
    return points_from(bent.graph.map[k + ROUND], seen)[0]


def switch_layers(page: Page, *layers: str) -> None:
    """On or off; and open or close their list."""
    page.run("const list = document.querySelector('.layers'); list.open = !list.open")
    for layer in layers:
        page.run("document.getElementById(arguments[0]).click()", f"layer-{layer}")


def click_at(page: Page, xy_map: Sequence[float]) -> None:
    """A click of the tool that is at work."""
    page.run(
        "corridor.edit.tool.click(corridor.view.camera.toScreen(...arguments))",
        float(xy_map[0]),
        float(xy_map[1]),
    )


def save_picture(page: Page, name: str) -> None:
    page.redraw()
    page.driver.save_screenshot(str(IMAGES / f"operator-{name}.png"))


def health(stamp_ns: int, state: str = "ok") -> encoding.Message:
    sensor = {"state": "streaming", "dropped": "0"}
    rows = [
        encoding.Status(
            f"sensor/{name}", 0, "ok", {**sensor, "rate_hz": rate, "age_s": age, "device_clock_s": clock_s}
        )
        for name, rate, age, clock_s in (
            ("front", "25.0", "0.02", "8130"),
            ("rear", "10.0", "0.06", "8121"),
            ("base", "66.7", "0.01", ""),
        )
    ]
    rest = [status for status in statuses(state) if not status.name.startswith("sensor/")]
    return encoding.encode_diagnostics("diagnostics", [*rows, *rest], stamp_ns, stamp_ns)


@contextmanager
def driving(server: WebServer, outputs: list[MapperOutput], seen: list[LaserScan]) -> Iterator[None]:
    """The last two seconds, again and again, at their own pace."""
    end_ns = outputs[-1].stamp_ns
    messages = [(o.stamp_ns, encoding.encode_pose(o, o.stamp_ns + UNIX_NS + 8_000_000)) for o in outputs]
    messages += [(s.stamp_ns, encoding.encode_frame(s)) for s in seen]
    last = sorted((m for m in messages if m[0] > end_ns - SHOWN_S * 1e9), key=lambda m: m[0])

    def drive(ended: threading.Event) -> None:
        random = np.random.default_rng(1)
        server.put(encoding.encode_tf_static(MOUNTINGS, UNIX_NS, UNIX_NS))
        server.put(event('{"event": "start"}', 0.0))
        server.put(event('{"event": "mark", "text": "door to the store room is open"}', 41.0))
        while not ended.is_set():
            server.put(health(end_ns + UNIX_NS))
            began_s = time.monotonic()
            for stamp_ns, message in last:
                due_s = began_s + (stamp_ns - last[0][0]) / 1e9
                if ended.wait(max(0.0, due_s - time.monotonic())):
                    return
                late_ns = int(random.gamma(4.0, 0.7e6))
                server.put(message, time.monotonic_ns() - late_ns if message.channel == "pose" else None)

    with in_background(drive):
        yield


def take(page: Page, name: str, area: str, size: tuple[int, int], is_dark: bool) -> None:
    page.resize(size, is_dark)
    page.choose(area)
    before = page.run("return corridor.view.frames")
    page.wait_for("return corridor.view.frames > arguments[0] + 10 && corridor.view.isLive", before)
    page.driver.save_screenshot(str(IMAGES / f"operator-{name}.png"))


def take_live_edit(page: Page) -> None:
    """The map of the running session: an area about to be erased."""
    page.resize(DESKTOP)
    page.choose("edit")
    page.element("fetch-keyframes").click()
    page.wait_for_text("edit-note", "Fetched: ")
    x_m, y_m = page.run("return corridor.edit.keyframes.at(20)")
    page.look_at(x_m, y_m, 38.0)
    page.element("draw-area").click()
    for dx_m, dy_m in ((1.0, 1.2), (3.4, 1.2), (3.4, 2.6), (1.0, 2.6)):
        click_at(page, (x_m + dx_m, y_m + dy_m))
    page.run("document.querySelector('#edit .cards').scrollTop = 0")
    take(page, "edit-live", "edit", DESKTOP, False)
    page.run("document.getElementById('map').focus(); corridor.edit.endTool()")
    page.element("fit").click()


def main() -> None:
    store = TileStore()
    office = map_office(store)
    with tempfile.TemporaryDirectory() as kept, chromium() as page:
        folders = {"session": Path(kept) / "sessions", "map": Path(kept) / "maps"}
        for folder in folders.values():
            folder.mkdir()
        stored = folders["map"] / "office_ground_floor"
        save_map(stored, store.since(0), UNIX_NS, graph=office.saved)
        answer = Answer(True, json.dumps({"ok": True, "folder": str(stored)}).encode())  # of save_map
        for number in (1, 2):
            (folders["session"] / f"veh1_20261118T061320Z_000{number}.mcap").write_bytes(
                b"\0" * 7_340_032 * number
            )
        about = About("veh1", "corridor", lambda: VERBS, tuple(METHODS))
        config = WebConfig(listen="127.0.0.1:0")
        server = WebServer(config, about, store, lambda verb, payload: answer, "t", folders)
        poses = [output.pose_map_base for output in office.outputs]
        server.put_path(np.array([(pose.x_m, pose.y_m) for pose in poses], np.float32))
        server.start()
        assert server.wait_served(10.0)
        server.put(encoding.encode_graph(office.graph, UNIX_NS))
        with driving(server, office.outputs, office.seen):
            page.open(server.address, "t")
            page.wait_for(
                "const r = corridor.report();"
                "return r.mayControl && r.sensors.length === 2 && 'rear' in (r.health?.latency_ms ?? {})"
            )
            take(page, "desktop-light", "information", DESKTOP, False)
            page.element("fit").click()
            take(page, "desktop-dark", "control", DESKTOP, True)
            switch_layers(page, "graph", "path")
            take(page, "graph", "information", DESKTOP, False)
            switch_layers(page, "graph", "path")
            take(page, "resources", "resources", DESKTOP, False)
            take_live_edit(page)
            take(page, "phone-map", "map", PHONE, False)
            take(page, "phone-information", "information", PHONE, True)
        server.close()
        with chromium() as fresh:  # the first one has had a phone's scroll bars, which lie on the page
            take_replay(fresh, office.frames, Path(kept) / "recorded")
            take_report(fresh, office.frames, Path(kept) / "reported")
            take_past(fresh, office, Path(kept))
            take_loops(fresh, stored)
            take_edit(fresh, Path(kept) / "ring")


if __name__ == "__main__":
    main()
