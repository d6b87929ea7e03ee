"""What the page costs and how fast it is, in Chromium on this machine: `python -m tests.browser.measure`.

A figure here depends on the machine and on what else it does, so it is printed and judged by people.
"""

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from drivers.frames import LaserScan
from service.encoding import encode_frame
from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.web.config import WebConfig
from service.web.server import About, WebServer
from tests.browser import watched_mapping
from tests.browser.conftest import DESKTOP, HEADLESS, Page, start_chromium
from tests.browser.scene import Scene, stamp
from tests.in_background import in_background

LASERS = (("front", 541, 50.0), ("rear", 1081, 40.0), ("lux", 440, 25.0))
SETTLE_S = 2.0
STEADY_S = 10.0
BROWSERS = 8
LOOK = """
import asyncio, sys, aiohttp

async def look(address):
    async with aiohttp.ClientSession() as session:
        async with session.ws_connect(address + "ws", max_msg_size=0) as socket:
            async for message in socket:
                pass

async def all_of_them():
    await asyncio.gather(*(look(sys.argv[1]) for _ in range(int(sys.argv[2]))))

asyncio.run(all_of_them())
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
        with subprocess.Popen([sys.executable, "-c", LOOK, server.address, str(BROWSERS)]) as lookers:
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


def in_chromium() -> dict[str, Any]:
    with chromium() as page:
        return {"large_map": measure_large_map(page), "steady": measure_steady(page)}


def main() -> None:
    """`python -m tests.browser.measure [chromium] [mapping]`, both where none is named."""
    parts = {"chromium": in_chromium, "mapping": watched_mapping.measure}
    for name in sys.argv[1:] or parts:
        print(json.dumps({name: parts[name]()}, indent=1), flush=True)


if __name__ == "__main__":
    main()
