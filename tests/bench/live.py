"""The live service under load: five fake devices, three lasers mapped, recording on, in `corridor demo`.

How fast this machine is just now stands beside: what a fixed loop of Python and a fixed kernel take.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from service.kernels.deskew import deskew_points
from tests.demo_run import DemoRun, run_demo

SECONDS = 30
SPIN = "while True: pass"
Row = tuple[str, float, str]


def measure() -> list[Row]:
    rows = speed()
    for what, programs in (("alone", 0), ("one core taken", 1), ("both cores taken", 2)):
        with tempfile.TemporaryDirectory() as folder, spinning(programs):
            rows += _rows(what, run_demo(SECONDS, Path(folder)))
    return rows


def speed() -> list[Row]:
    """How long fixed work takes, ms: of the interpreter, and of compiled code."""
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
    """So many programs beside, each of which wants a core for itself."""
    spinners = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(programs)]
    try:
        yield
    finally:
        for spinner in spinners:
            spinner.kill()
            spinner.wait()


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
