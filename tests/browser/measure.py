"""What the page costs and how fast it is, in Chromium on this machine: `python -m tests.browser.measure`.

A figure here depends on the machine and on what else it does, so it is printed and judged by people.
"""

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.frames import LaserScan
from service.demo import DemoOptions, demo
from service.encoding import encode_frame
from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.recording.mcap_reader import Recording
from service.runtime.service import Service
from service.web.config import WebConfig
from service.web.server import About, WebServer
from tests.browser.conftest import DESKTOP, HEADLESS, Page, start_chromium
from tests.browser.scene import Scene, stamp
from tests.in_background import in_background

LASERS = (("front", 541, 50.0), ("rear", 1081, 40.0), ("lux", 440, 25.0))
SETTLE_S = 2.0
STEADY_S = 10.0
BROWSERS = 8
DEMO_S = 180.0
WINDOW_S = 4.0
WINDOW_SETTLE_S = 1.0  # at the begin of a window: browsers get the whole map first, or are gone
MIN_SCANS = 100  # of a window: its 99th percentile means nothing below
FOREVER_S = 1e9
READ = """
import base64, json, os, socket, sys, time

host, port, count, window_s = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
READ_PERIOD_S = 0.05

def opened():
    key = base64.b64encode(os.urandom(16)).decode()
    lines = ["GET /ws HTTP/1.1", f"Host: {host}:{port}", "Upgrade: websocket", "Connection: Upgrade"]
    lines += [f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13"]
    browser = socket.create_connection((host, port))
    browser.sendall(("\\r\\n".join(lines) + "\\r\\n" * 2).encode())
    browser.setblocking(False)
    return browser

while True:
    begins_s = time.time()
    browsers = [opened() for _ in range(count)]
    read = [0] * count
    while time.time() < begins_s + window_s:
        for i, browser in enumerate(browsers):
            try:
                came = len(browser.recv(1 << 20))
            except BlockingIOError:
                continue
            if came == 0:
                sys.exit("the service has closed")
            read[i] += came
        time.sleep(READ_PERIOD_S)
    for browser in browsers:
        browser.close()
    print(json.dumps([begins_s, begins_s + window_s, min(read)]), flush=True)
    time.sleep(window_s)
"""


@contextmanager
def chromium() -> Iterator[Page]:
    driver = start_chromium(HEADLESS)
    try:
        page = Page(driver)
        page.resize(DESKTOP)
        yield page
    finally:
        driver.quit()


@contextmanager
def driving(server: WebServer, scene: Scene) -> Iterator[None]:
    """As much as a vehicle with three lasers puts out, a quarter of the tiles around it changing."""
    scans: dict[str, LaserScan] = {name: scene.scan("front", 0.0, beams) for name, beams, _ in LASERS}
    tiles = scene.tiles()
    random = np.random.default_rng(1)

    def drive(ended: threading.Event) -> None:
        began_s, due_s = time.monotonic(), dict.fromkeys(scans, 0.0)
        tick = 0
        while not ended.wait(0.005):
            seconds = time.monotonic() - began_s
            for name, _, rate_hz in LASERS:
                if seconds >= due_s[name]:
                    due_s[name] += 1.0 / rate_hz
                    moment = {"stamp_ns": stamp(seconds), "arrived_ns": stamp(seconds)}
                    server.put(encode_frame(replace(scans[name], sensor=name, **moment)))
                    server.put(scene.messages(seconds)[1], time.monotonic_ns())
            if (tick := tick + 1) % 40 == 0:
                server.put(scene.messages(seconds)[-1])
                changed = []
                for tile in random.choice(len(tiles), 6, replace=False):
                    cells = tiles[tile].cells.copy()
                    cells[random.integers(0, 64, 40), random.integers(0, 64, 40)] = random.integers(
                        0, 101, 40
                    )
                    version = scene.store.version + len(changed) + 1
                    changed.append(type(tiles[0])(0, tiles[tile].ix, tiles[tile].iy, version, 0.05, cells))
                scene.store.update(changed)

    with in_background(drive):
        yield


def new_server(store: TileStore) -> WebServer:
    about = About("veh1", "corridor", lambda: [])
    server = WebServer(
        WebConfig(listen="127.0.0.1:0"), about, store, lambda verb, payload: Answer(True, b"{}"), "t"
    )
    server.start()
    assert server.wait_served(10.0)
    return server


def measure_large_map(page: Page) -> dict[str, Any]:
    """A room of 12 000 m2, its cells in noise so that nothing compresses away unduly."""
    scene = Scene(half_x_m=75.0, half_y_m=40.0)
    random = np.random.default_rng(1)
    for tile in scene.tiles():
        cells = tile.cells.copy()
        known = cells >= 0
        cells[known] = np.where(random.random(known.sum()) < 0.1, 100, random.integers(0, 12, known.sum()))
        scene.store.update([type(tile)(0, tile.ix, tile.iy, tile.version, tile.cell_m, cells)])
    server = new_server(scene.store)
    began_s = time.monotonic()
    page.driver.get(server.address)
    page.wait_for(
        "return window.corridor && corridor.report().tiles >= arguments[0]", len(scene.store.since(0))
    )
    opened_s = time.monotonic() - began_s
    bytes_received = page.report()["bytes"]
    server.close()
    return {
        "square_metres": 4 * scene.half_x_m * scene.half_y_m,
        "opened_s": round(opened_s, 2),
        "megabytes": round(bytes_received / 1e6, 2),
    }


def measure_steady(page: Page) -> dict[str, float]:
    scene = Scene()
    scene.map_all()
    server = new_server(scene.store)
    with driving(server, scene):
        page.driver.get(server.address)
        page.wait_for("return window.corridor && corridor.report().pose !== null")
        before, began_s = page.report()["bytes"], time.monotonic()
        with_one = cpu_percent()
        kilobits = (page.report()["bytes"] - before) * 8e-3 / (time.monotonic() - began_s)
        page.driver.get("about:blank")
        idle = cpu_percent()
        place = server.address.removeprefix("http://").rstrip("/").split(":")
        reading = [sys.executable, "-c", READ, *place, str(BROWSERS), str(FOREVER_S)]
        with subprocess.Popen(reading) as lookers:
            with_many = cpu_percent()
            assert server.health().values["browsers"] == str(BROWSERS)
            lookers.terminate()
    server.close()
    return {
        "kilobits_per_s": round(kilobits),
        "cpu_percent_with_none": round(idle, 1),
        "cpu_percent_with_one": round(with_one, 1),
        f"cpu_percent_with_{BROWSERS}": round(with_many, 1),
    }


def cpu_percent() -> float:
    """Of a core, all threads of this process: those that drive and those that serve."""
    time.sleep(SETTLE_S)  # a browser that has just come asks for the whole map: that is not the steady state
    before_cpu_s = time.process_time()
    time.sleep(STEADY_S)  # what is measured is what happens in this time
    return 100 * (time.process_time() - before_cpu_s) / STEADY_S


class Watched:
    """`corridor demo` with browsers and without them in turn, from its READY on.

    Windows with BROWSERS open and windows with none follow each other in one run, so that the load of the
    machine falls on both alike: a pair is a window and the one after it. Browsers draw on machines of
    their own: a program of one thread stands for all of them here.
    """

    def __init__(self) -> None:
        self.windows: list[tuple[float, float]] = []  # in which they were open, Unix time
        self.least_read = 2**63  # bytes in a window, of the browser that got least
        self._reader: subprocess.Popen[str] | None = None

    def run(self, out: Path) -> dict[str, Any]:
        """The summary of the demo."""
        try:
            return demo(DemoOptions(DEMO_S, None, None, 1, out), watch=self._watch)
        finally:
            if self._reader is not None:
                self._reader.terminate()
                self._reader.wait()

    def _watch(self, service: Service) -> None:
        if self._reader is not None or service.running_status is None:
            return
        host, _, port = service.places["web"].removeprefix("http://").rstrip("/").partition(":")
        command = [sys.executable, "-c", READ, host, port, str(BROWSERS), str(WINDOW_S)]
        self._reader = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        threading.Thread(target=self._note_windows, args=(self._reader,), daemon=True).start()

    def _note_windows(self, reader: "subprocess.Popen[str]") -> None:
        assert reader.stdout is not None
        for line in reader.stdout:
            begins_s, ends_s, read = json.loads(line)
            self.windows.append((begins_s, ends_s))
            self.least_read = min(self.least_read, read)

    def pairs(self) -> list[tuple[tuple[float, float], tuple[float, float]]]:
        """(with browsers, with none), each from when it has settled to its end, Unix time, s."""
        return [
            ((begins_s + WINDOW_SETTLE_S, ends_s), (ends_s + WINDOW_SETTLE_S, ends_s + WINDOW_S))
            for begins_s, ends_s in self.windows
        ]


def latencies(session: Path) -> npt.NDArray[np.float64]:
    """(scans, 2): Unix time at which a scan's last byte was read, s; from then to the pose's message, ms."""
    read_ns: dict[int, int] = {}  # stamp of a scan -> when its last byte was read
    rows = []
    for message in Recording([session]).messages():
        if message.channel.endswith("/scan"):
            read_ns[message.stamp_ns] = message.log_ns
        elif message.channel == "pose" and message.stamp_ns in read_ns:
            read = read_ns[message.stamp_ns]
            rows.append((read / 1e9, (message.log_ns - read) / 1e6))
    return np.array(rows).reshape(-1, 2)


def measure_mapping() -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as out:
        watched = Watched()
        summary = watched.run(Path(out))
        rows = latencies(Path(summary["session"]))
    pairs = []
    for windows in watched.pairs():
        inside = [rows[(rows[:, 0] >= begin_s) & (rows[:, 0] < end_s), 1] for begin_s, end_s in windows]
        if min(map(len, inside)) >= MIN_SCANS:
            pairs.append(inside)
    watched_ms, alone_ms = (np.concatenate([inside[i] for inside in pairs]) for i in (0, 1))
    return {
        "browsers": BROWSERS,
        "pairs_of_windows": len(pairs),
        "latency_ms_with_none": _percentiles(alone_ms),
        f"latency_ms_with_{BROWSERS}": _percentiles(watched_ms),
        "kilobytes_read_in_a_window": round(watched.least_read / 1e3),
        "scans_passed_over": summary["scans_dropped"],
        "void": summary["void"],  # why the figures say nothing, if they do
    }  # fmt: skip


def _percentiles(values_ms: npt.NDArray[np.float64]) -> dict[str, float]:
    p50, p95, p99 = np.percentile(values_ms, (50, 95, 99)).round(2).tolist()
    return {"p50": p50, "p95": p95, "p99": p99, "scans": len(values_ms)}


def in_chromium() -> dict[str, Any]:
    with chromium() as page:
        return {"large_map": measure_large_map(page), "steady": measure_steady(page)}


def main() -> None:
    """`python -m tests.browser.measure [chromium] [mapping]`, both where none is named."""
    parts = {"chromium": in_chromium, "mapping": measure_mapping}
    for name in sys.argv[1:] or parts:
        print(json.dumps({name: parts[name]()}, indent=1), flush=True)


if __name__ == "__main__":
    main()
