"""What the page costs and how fast it is, in Chromium on this machine: `python -m tests.browser.measure`.

A figure here depends on the machine and on what else it does, so it is printed and judged by people.
"""

import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from selenium import webdriver
from selenium.webdriver.chrome.service import Service

from drivers.frames import LaserScan
from service.encoding import encode_frame
from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.web.config import WebConfig
from service.web.server import About, WebServer
from tests.browser.conftest import DESKTOP, Page
from tests.browser.scene import Scene, stamp
from tests.in_background import in_background

LASERS = (("front", 541, 50.0), ("rear", 1081, 40.0), ("lux", 440, 25.0))
SETTLE_S = 2.0
STEADY_S = 10.0
PAN_S = 5.0
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
DEMO_S = 20.0
COUNT = """
import asyncio, json, sys, time, aiohttp

SETTLE_S = 5.0  # the whole map comes first

async def look(session, address):
    '''Kilobits a second, from SETTLE_S after the first pose to the end of the service.'''
    while True:
        try:
            socket = await session.ws_connect(address + "ws", max_msg_size=0)
            break
        except aiohttp.ClientError:
            await asyncio.sleep(0.1)
    began_s, total, last_s = None, 0, 0.0
    async for message in socket:
        now_s = time.monotonic()
        if began_s is None:
            began_s = now_s + SETTLE_S if '"type":"pose"' in str(message.data)[:20] else None
        elif now_s >= began_s:
            total, last_s = total + len(message.data), now_s
    return total * 8e-3 / (last_s - began_s)

async def all_of_them():
    async with aiohttp.ClientSession() as session:
        looks = (look(session, sys.argv[1]) for _ in range(int(sys.argv[2])))
        print(json.dumps(await asyncio.gather(*looks)))

asyncio.run(all_of_them())
"""


@contextmanager
def chromium() -> Iterator[Page]:
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    driver = webdriver.Chrome(
        options=options, service=Service(shutil.which("chromedriver") or "chromedriver")
    )
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
                    held = scans[name]
                    frame = LaserScan(
                        name, stamp(seconds), stamp(seconds), held.beam_interval_ns, held.scan_period_ns,
                        held.first_angle_rad, held.angle_step_rad, held.range_min_m, held.range_max_m,
                        held.range_m, held.intensity,
                    )  # fmt: skip
                    server.put(encode_frame(frame))
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


def measure_large_map(page: Page) -> dict[str, float]:
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
    page.run("corridor.view.fit()")
    result = page.driver.execute_async_script(
        "const done = arguments[1], v = corridor.view, began = performance.now();"
        "let frames = 0; v.drawn_ms.length = 0;"
        "const median = (values) => values.toSorted((a, b) => a - b)[values.length >> 1];"
        "const step = (now) => { frames += 1;"
        "v.camera.panBy(8 * Math.cos(now / 300), 8 * Math.sin(now / 300));"
        "v.camera.scale = 12 + 8 * Math.sin(now / 900); v.invalidate();"
        "if (now < began + 1000 * arguments[0]) requestAnimationFrame(step);"
        "else done([1000 * frames / (now - began), median(v.drawn_ms)]); };"
        "requestAnimationFrame(step);",
        PAN_S,
    )
    bytes_received = page.report()["bytes"]
    server.close()
    return {
        "square_metres": 4 * scene.half_x_m * scene.half_y_m,
        "opened_s": round(opened_s, 2),
        "megabytes": round(bytes_received / 1e6, 2),
        "frames_per_s_panning": round(result[0], 1),
        "draw_ms_p50": round(result[1], 2),
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


def measure_mapping() -> dict[str, Any]:
    """`corridor demo` with nobody looking, and with several who look: latency of a scan to its pose, ms."""
    alone, _ = demo(0)
    watched, kilobits = demo(BROWSERS)
    return {
        "latency_ms_with_none": alone["latency_ms"],
        f"latency_ms_with_{BROWSERS}": watched["latency_ms"],
        "scan_cpu_ms_with_none": alone["scan_cpu_ms"],
        f"scan_cpu_ms_with_{BROWSERS}": watched["scan_cpu_ms"],
        "cpu_percent_with_none": alone["cpu_percent"],
        f"cpu_percent_with_{BROWSERS}": watched["cpu_percent"],
        "kilobits_per_s": round(max(kilobits)),
        "void": alone["void"] or watched["void"],  # why these figures say nothing, if they do
    }


def demo(browsers: int) -> tuple[dict[str, Any], list[float]]:
    """Its summary, and what each of the programs that looked at its page got, kbit/s."""
    with tempfile.TemporaryDirectory() as out, subprocess.Popen(
        [sys.executable, "-m", "service", "demo", "--seconds", str(DEMO_S), "--json", "--out", out],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        said = [process.stderr.readline()]
        address = said[0].rpartition(" ")[2].partition("#")[0]
        looking = [sys.executable, "-c", COUNT, address, str(browsers)]
        with subprocess.Popen(looking, stdout=subprocess.PIPE, text=True) as lookers:
            assert lookers.stdout is not None
            said += process.stderr.readlines()  # until it ends
            summary = process.stdout.read()
            assert summary, "".join(said)
            return json.loads(summary), json.loads(lookers.stdout.read())


def cpu_percent() -> float:
    """Of a core, all threads of this process: those that drive and those that serve."""
    time.sleep(SETTLE_S)  # a browser that has just come asks for the whole map: that is not the steady state
    before_cpu_s = time.process_time()
    time.sleep(STEADY_S)  # what is measured is what happens in this time
    return 100 * (time.process_time() - before_cpu_s) / STEADY_S


def main() -> None:
    with chromium() as page:
        told = {"large_map": measure_large_map(page), "steady": measure_steady(page)}
    print(json.dumps(told | {"mapping": measure_mapping()}, indent=1))


if __name__ == "__main__":
    main()
