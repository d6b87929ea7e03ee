"""What the page costs and how fast it is, in Chromium on this machine: `python -m tests.browser.measure`.

A figure here depends on the machine and on what else it does, so it is printed and judged by people.
"""

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.frames import LaserScan
from service.encoding import encode_frame
from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.web.config import WebConfig
from service.web.server import About, WebServer
from tests.browser import watched_mapping
from tests.browser.conftest import DESKTOP, HEADLESS, PHONE, Page, start_chromium
from tests.browser.scene import Scene, stamp
from tests.in_background import in_background

LASERS = (("front", 541, 50.0), ("rear", 1081, 40.0), ("lux", 440, 25.0))
SETTLE_S = 2.0
STEADY_S = 10.0
SLOWER = 4  # a phone's processor
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
DEMO_S = 28.0
COUNT_S = 20.0
COUNT = """
import asyncio, sys, time, aiohttp

SETTLE_S = 5.0  # the whole map comes first

async def look(address, seconds):
    url = address + "ws"
    async with aiohttp.ClientSession() as session, session.ws_connect(url, max_msg_size=0) as socket:
        began_s, total = time.monotonic(), 0
        async for message in socket:
            past_s = time.monotonic() - began_s
            total += len(message.data) if past_s >= SETTLE_S else 0
            if past_s >= seconds:
                print(total * 8e-3 / (past_s - SETTLE_S))
                return

asyncio.run(look(sys.argv[1], float(sys.argv[2])))
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


def pan(page: Page) -> dict[str, float]:
    """Panning and zooming for PAN_S: frames, and how long a picture takes to be drawn."""
    per_s, draw_ms, longest_ms = page.driver.execute_async_script(
        "const done = arguments[1], v = corridor.view, began = performance.now();"
        "let frames = 0, before = began, longest = 0; v.drawn_ms.length = 0;"
        "const median = (values) => values.toSorted((a, b) => a - b)[values.length >> 1];"
        "const step = (now) => { frames += 1; longest = Math.max(longest, now - before); before = now;"
        "v.camera.panBy(8 * Math.cos(now / 300), 8 * Math.sin(now / 300));"
        "v.camera.scale = 12 + 8 * Math.sin(now / 900); v.invalidate();"
        "if (now < began + 1000 * arguments[0]) requestAnimationFrame(step);"
        "else done([1000 * frames / (now - began), median(v.drawn_ms), longest]); };"
        "requestAnimationFrame(step);",
        PAN_S,
    )
    return {
        "frames_per_s_panning": round(per_s, 1),
        "longest_frame_ms": round(longest_ms, 1),
        "draw_ms_p50": round(draw_ms, 2),
    }


def measure_phone(page: Page, address: str, tiles: int) -> dict[str, float]:
    """A processor of a quarter of this one's speed, the size of a phone, the page's files in its cache."""
    page.resize(PHONE)
    page.driver.execute_cdp_cmd("Emulation.setCPUThrottlingRate", {"rate": SLOWER})
    try:
        page.driver.get("about:blank")
        before_s = page.thread_s()
        page.driver.get(address)
        page.wait_for("return window.corridor && corridor.report().tiles > 0 && corridor.view.frames > 0")
        first_ms = page.run("return corridor.view.firstMap_ms")
        page.wait_for("return corridor.report().tiles >= arguments[0]", tiles)
        opened_ms = page.run("return performance.now()")
        thread_ms = 1000 * (page.thread_s() - before_s)
        page.run("corridor.view.fit()")
        return {
            "first_picture_ms": round(first_ms),
            "opened_ms": round(opened_ms),
            "opened_thread_ms": round(thread_ms),
            **pan(page),
        }
    finally:
        page.driver.execute_cdp_cmd("Emulation.setCPUThrottlingRate", {"rate": 1})
        page.resize(DESKTOP)


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
    page.run("corridor.view.fit()")
    browser = [page.driver.service.process.pid, *_below(page.driver.service.process.pid)]
    before_s, began_s = sum(map(_processor_s, browser)), time.monotonic()
    smooth = pan(page)
    busy = (sum(map(_processor_s, browser)) - before_s) / (time.monotonic() - began_s)
    bytes_received = page.report()["bytes"]
    phone = measure_phone(page, server.address, len(scene.store.since(0)))
    server.close()
    return {
        "square_metres": 4 * scene.half_x_m * scene.half_y_m,
        "opened_s": round(opened_s, 2),
        "megabytes": round(bytes_received / 1e6, 2),
        **smooth,
        "browser_percent_of_a_core": round(100 * busy),
        "phone": phone,
    }


def _below(pid: int) -> list[int]:
    """Processes that it has started, and theirs."""
    started = [
        int(child)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for child in (task / "children").read_text().split()
    ]
    return [*started, *(process for child in started for process in _below(child))]


def _processor_s(pid: int) -> float:
    """That its threads have had so far (proc(5), stat: utime and stime)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


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


def demo(out: str, looking: Sequence[str]) -> tuple[dict[str, Any], str]:
    """Its summary, and what the program said that looks at its page from READY to its end."""
    program, *arguments = looking
    with subprocess.Popen(
        [sys.executable, "-m", "service", "demo", "--seconds", str(DEMO_S), "--json", "--out", out],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stderr is not None
        said = [process.stderr.readline()]
        address = said[0].rpartition(" ")[2].partition("#")[0]
        while "ready;" not in said[-1]:
            said.append(process.stderr.readline())
            assert said[-1], "".join(said)
        command = [sys.executable, "-c", program, address, *arguments]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as looker:
            assert looker.stdout is not None
            said += process.stderr.readlines()  # until it ends
            summary = process.stdout.read()
            looker.terminate()
            assert summary, "".join(said)
            return json.loads(summary), looker.stdout.read()


def measure_traffic() -> dict[str, float]:
    """What one browser gets from `corridor demo`, kbit/s."""
    with tempfile.TemporaryDirectory() as out:
        _, said = demo(out, [COUNT, str(COUNT_S)])
    return {"kilobits_per_s": round(float(said))}


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
    """`python -m tests.browser.measure [chromium] [mapping] [traffic]`, all of them where none is named."""
    parts = {"chromium": in_chromium, "mapping": watched_mapping.measure, "traffic": measure_traffic}
    for name in sys.argv[1:] or parts:
        print(json.dumps({name: parts[name]()}, indent=1), flush=True)


if __name__ == "__main__":
    main()
