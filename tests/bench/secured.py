"""Latency that TLS, certificates and rules of access add, end to end: from the last byte of a scan to
its pose in a subscriber of another process.

In one drive of `corridor demo` a plain and a secured endpoint send each pose, in turn first; only those that
it sends first count for either. So other load of the machine does not bias the difference.
`python -m tests.bench.secured ENDPOINT [SITE]` is a subscriber; with the folder of a site it is its viewer.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
import zenoh

from drivers.zenoh_callback import daemon_callback
from drivers.zenoh_config import zenoh_config
from service.compile.warm_up import warm_up
from service.demo import VEHICLE, DemoOptions, demo_config, simulators
from service.encoding import Message, Status, decode_pose
from service.encoding import warm_up as warm_up_encoding
from service.offline.security.authority import Holder, init_site
from service.outputs import TileUpdate
from service.publishing.config import PublishingConfig
from service.publishing.keys import vehicle_key
from service.recording.mcap_reader import Recording
from service.runtime.run import run
from service.runtime.service import Service
from service.sinks.sink import Shared, Sink, SinkContext
from service.sinks.zenoh_sink import ZenohSink
from tests.system.machine import free_port

SECONDS = 250.0
SETTLE_S = 10.0  # subscribers connect, clocks are learnt
PAIRS = 8  # into which the rest is divided
HOSTS = ("127.0.0.1", "localhost")
Row = tuple[str, float, str]


class InTurn(Sink):
    """Publishers of the same messages, each pose first by another one; notes by which."""

    name = "zenoh"

    def __init__(self, publishers: Sequence[Sink]) -> None:
        self._publishers = list(publishers)
        self.first: dict[int, int] = {}  # stamp of a pose, ns -> which sent it first
        self._turn = 0

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        order = self._publishers
        if message.channel == "pose":
            self._turn = (self._turn + 1) % len(order)
            self.first[message.stamp_ns] = self._turn
            order = [*order[self._turn :], *order[: self._turn]]
        for publisher in order:
            publisher.put(message, arrived_ns)

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        for publisher in self._publishers:
            publisher.put_tiles(tiles, stamp_ns, log_ns)

    def health(self) -> Status:
        return self._publishers[0].health()

    def close(self) -> None:
        for publisher in self._publishers:
            publisher.close()


def measure() -> list[Row]:
    warm_up_encoding()
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder) / "site"
        init_site(site, [Holder(VEHICLE, "vehicle", HOSTS), Holder("hall", "viewer")], days=2)
        plain, secured = _drive(Path(folder), site)
    rows: list[Row] = []
    for percent in (50, 99):
        parts = [np.array_split(taken_ms, PAIRS) for taken_ms in (plain, secured)]
        ratios = sorted(
            np.percentile(b, percent) / np.percentile(a, percent) for a, b in zip(*parts, strict=True)
        )
        rows += [
            (f"without security, p{percent}", float(np.percentile(plain, percent)), "ms"),
            (f"with security, p{percent}", float(np.percentile(secured, percent)), "ms"),
            (
                f"p{percent}, with over without",
                float(np.percentile(secured, percent) / np.percentile(plain, percent)),
                "",
            ),
            (f"the same, median of {PAIRS} parts", float(np.median(ratios)), ""),
            (f"the same, worst of {PAIRS} parts", float(ratios[-1]), ""),
        ]
    return [*rows, ("poses without security", len(plain), ""), ("poses with security", len(secured), "")]


def _drive(folder: Path, site: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """From each scan's last byte to its pose in the subscriber, ms: without security, with it."""
    options = DemoOptions(None, None, None, 1, folder, web=False)
    endpoints = [f"tcp/127.0.0.1:{free_port()}", f"tls/127.0.0.1:{free_port()}"]
    files = {"certificate": f"{site}/{VEHICLE}.pem", "key": f"{site}/{VEHICLE}.key"}
    roles = {"viewer": ["hall"], "vehicle": [VEHICLE]}
    configs = [
        PublishingConfig.model_validate({"listen": [endpoints[0]]}),
        PublishingConfig.model_validate(
            {"listen": [endpoints[1]], "security": {"tls": {"ca": f"{site}/ca.pem", **files}, "roles": roles}}
        ),
    ]
    sinks: list[InTurn] = []

    def open_sinks(config: PublishingConfig, context: SinkContext) -> Sink:
        sinks.append(InTurn([ZenohSink(one, replace(context, shared=Shared())) for one in configs]))
        return sinks[0]

    subscribers: list[subprocess.Popen[str]] = []

    def subscribe(service: Service) -> None:
        if subscribers or service.running_status is None:
            return
        for endpoint, of_site in zip(endpoints, ([], [str(site)]), strict=True):
            command = [sys.executable, "-m", "tests.bench.secured", endpoint, *of_site]
            subscribers.append(
                opened.enter_context(
                    subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
                )
            )

    with ExitStack() as opened, patch("service.sinks.zenoh_sink.ZenohSink", open_sinks):
        with simulators(options, folder / "truth.txt") as fakes:
            config = demo_config(fakes.endpoints, options, free_port())
            summary = run(config, SECONDS, folder / "map", give_up=fakes.fault, watch=subscribe)
        came_lines = [subscriber.communicate()[0] for subscriber in subscribers]  # ends their standard input
    read_ns = {
        message.stamp_ns: message.log_ns
        for message in Recording(summary.sessions).messages()
        if message.channel.endswith("/scan")
    }
    settled_ns = min(read_ns.values()) + round(SETTLE_S * 1e9)
    taken_ms = []
    for which, lines in enumerate(came_lines):
        came = [tuple(map(int, line.split())) for line in lines.splitlines()]
        taken_ms.append(
            np.array(
                [
                    (now_ns + summary.utc_offset_ns - read_ns[stamp_ns]) / 1e6
                    for stamp_ns, now_ns in came
                    if read_ns.get(stamp_ns, 0) >= settled_ns and sinks[0].first[stamp_ns] == which
                ]
            )
        )
        assert len(taken_ms[-1]) > 10 * SECONDS, (
            f"{len(taken_ms[-1])} poses came; did the subscriber connect?"
        )
    return taken_ms[0], taken_ms[1]


def _subscribe(endpoint: str, site: str | None) -> None:
    """Prints, at the end of its standard input, each pose's stamp and when it came, ns: Unix, monotonic."""
    came: list[tuple[bytes, int]] = []

    def take(sample: zenoh.Sample) -> None:
        now_ns = time.monotonic_ns()
        came.append((sample.payload.to_bytes(), now_ns))

    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 20_000,
    }
    if site is not None:
        settings["transport/link/tls"] = {
            "root_ca_certificate": f"{site}/ca.pem",
            "enable_mtls": True,
            "connect_certificate": f"{site}/hall.pem",
            "connect_private_key": f"{site}/hall.key",
        }
    with zenoh.open(zenoh_config(settings)) as session:
        session.declare_subscriber(vehicle_key(VEHICLE, "pose"), daemon_callback(take, "poses"))
        sys.stdin.read()
    for payload, now_ns in came:
        print(decode_pose(payload).stamp_ns, now_ns)


if __name__ == "__main__":
    _subscribe(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None)
