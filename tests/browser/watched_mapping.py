"""What browsers cost the mapping: `python -m tests.browser.watched_mapping [SECONDS]`, of `corridor demo`.

Windows with BROWSERS open and windows with none follow each other in one run, so that the machine's own ups
and downs fall on both alike: a pair is a window and the one after it. Browsers draw on machines of their own;
a program of one thread stands for all of them here. It takes what has come every READ_PERIOD_S and looks at
nothing, so that the figures are those of the service. They are printed and judged by people.
"""

import json
import logging
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from service.demo import DemoOptions, demo
from service.recording.mcap_reader import Recording
from service.runtime.service import Service

SECONDS = 180.0
BROWSERS = 8
WINDOW_S = 4.0
SETTLE_S = 1.0  # at the begin of a window: browsers get the whole map first, or are gone
MIN_SCANS = 100  # of a window: its 99th percentile means nothing below
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


class Watched:
    """`corridor demo` with browsers and without them in turn, from its READY on."""

    def __init__(self) -> None:
        self.windows: list[tuple[float, float]] = []  # in which they were open, Unix time
        self.least_read = 2**63  # bytes in a window, of the browser that got least
        self._reader: subprocess.Popen[str] | None = None

    def run(self, seconds: float, out: Path) -> dict[str, Any]:
        """The summary of the demo."""
        try:
            return demo(DemoOptions(seconds, None, None, 1, out), watch=self._watch)
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
            ((begins_s + SETTLE_S, ends_s), (ends_s + SETTLE_S, ends_s + WINDOW_S))
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


def measure(seconds: float = SECONDS) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as out:
        watched = Watched()
        summary = watched.run(seconds, Path(out))
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


def main() -> None:
    logging.basicConfig(level=logging.WARNING)
    print(json.dumps(measure(*map(float, sys.argv[1:])), indent=1))


if __name__ == "__main__":
    main()
