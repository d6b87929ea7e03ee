"""The live service under load: five fake devices, three lasers mapped, recording on, in `corridor demo`.

Rows beside give the machine's speed: times of a fixed loop of Python and of a fixed kernel.
"""

import select
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np

from service.demo import WEB_PORT
from service.kernels.deskew import deskew_points
from tests.demo_run import DemoRun, run_demo

SECONDS = 30
SPIN = "while True: pass"
SILENT = 4
HANDSHAKE = (
    f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{WEB_PORT}\r\nOrigin: http://127.0.0.1:{WEB_PORT}\r\n"
    "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n"
    "Sec-WebSocket-Version: 13\r\n\r\n"
).encode()
Row = tuple[str, float, str]


def measure() -> list[Row]:
    rows = speed()
    for what, load in (
        ("alone", nullcontext()),
        (f"{SILENT} browsers that never read", silent_browsers(SILENT)),
        ("one core taken", spinning(1)),
        ("both cores taken", spinning(2)),
    ):
        with tempfile.TemporaryDirectory() as folder, load:
            rows += _rows(what, run_demo(SECONDS, Path(folder)))
    return rows


def speed() -> list[Row]:
    """Duration of fixed work, ms: of the interpreter, and of compiled code."""
    xy, out = np.ones((1081, 2)), np.empty((1081, 2))
    times, twist = np.linspace(0.0, 0.02, 1081), np.array([1.0, 0.1, 0.2])
    deskew_points(xy, times, twist, out)
    python_ms, kernel_ms = [], []
    for _ in range(20):
        began_s = time.perf_counter()
        sum(i * i for i in range(100_000))
        python_ms.append(1e3 * (time.perf_counter() - began_s))
        began_s = time.perf_counter()
        for _ in range(100):
            deskew_points(xy, times, twist, out)
        kernel_ms.append(1e3 * (time.perf_counter() - began_s))
    return [
        ("sum of 100 000 squares in Python", float(np.median(python_ms)), "ms"),
        ("1081 points deskewed 100 times", float(np.median(kernel_ms)), "ms"),
    ]


@contextmanager
def spinning(programs: int) -> Iterator[None]:
    """So many programs beside, each of which takes a core."""
    spinners = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(programs)]
    try:
        yield
    finally:
        for spinner in spinners:
            spinner.kill()
            spinner.wait()


@contextmanager
def silent_browsers(count: int) -> Iterator[None]:
    """So many browsers that open the demo's page as soon as it is served and read nothing. One that is
    disconnected opens it again. Raises AssertionError where none was accepted.
    """
    ended = threading.Event()
    let_in = [0] * count

    def open_again(k: int) -> None:
        while not ended.is_set():
            try:
                with socket.create_connection(("127.0.0.1", WEB_PORT), 1.0) as silent:
                    silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                    silent.sendall(HANDSHAKE)
                    let_in[k] += silent.recv(12) == b"HTTP/1.1 101"
                    gone = select.poll()
                    gone.register(silent, select.POLLRDHUP)
                    while not ended.is_set() and not gone.poll(200):
                        pass
            except OSError:  # the page is not served yet, or not any more
                ended.wait(0.2)

    threads = [threading.Thread(target=open_again, args=(k,), name=f"silent-{k}") for k in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        for thread in threads:
            thread.join()
    assert all(let_in), f"browsers let in: {let_in}; is port {WEB_PORT} taken?"


def _rows(what: str, run: DemoRun) -> list[Row]:
    summary = run.summary
    latency, cpu_ms = summary["latency_ms"], summary["scan_cpu_ms"]["p50"]
    rows: list[Row] = [(f"{what}: scan to pose, {p}", latency[p], "ms") for p in ("p50", "p99", "max")]
    rows += [
        (f"{what}: p50 over the processor time of a scan", latency["p50"] / cpu_ms, ""),
        (f"{what}: p99 over the processor time of a scan", latency["p99"] / cpu_ms, ""),
        (f"{what}: processor time of a scan, p50", cpu_ms, "ms"),
        (f"{what}: scans mapped", summary["scans"], ""),
        (f"{what}: scans passed over", summary["scans_dropped"], ""),
        (f"{what}: position, RMSE", 1e3 * summary["position_rmse_m"], "mm"),
        (f"{what}: processor of ingest and mapper", summary["cpu_percent"], "% of a core"),
        (f"{what}: measurements that the fake devices could not send", sum(run.left_out.values()), ""),
    ]
    return rows
