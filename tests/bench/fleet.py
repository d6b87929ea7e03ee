"""Many vehicles at one router over TLS on loopback: bytes of each link, work of the router, who comes late, a
router that is away, a stranger.

`python -m tests.bench.fleet SITE ENDPOINT FIRST COUNT` is one process of vehicles, each with its own session.
"""

import json
import os
import resource
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import zenoh

from service.encoding import OK, Status, encode_diagnostics, encode_pose
from service.fleet.vehicles import connected, read_vehicles
from service.mapstore.tiles import TileStore
from service.offline.security.authority import Holder, init_site
from service.outputs import TileUpdate
from service.publishing.config import PublishingConfig
from service.sinks.fleet_sink import FleetSink
from tests.service.sinks.contexts import sink_context
from tests.service.test_encoding_outputs import OUTPUT
from tests.system.machine import free_port

COUNTS = (20, 100)
PROCESSES = 4
SECONDS = 20.0
AWAY_S = 60.0
START_S = 120.0
POSE_HZ = 12.5  # of the slowest laser; the policy lets 5 through
TILE_CELLS, TILES_AT_ONCE = 64, 2  # of a map that grows: 3.2 m of wall each, every 2 s
HEALTH_BYTES = 6000  # of a vehicle with three devices
HOSTS = ("127.0.0.1", "localhost")
Row = tuple[str, float, str]


def measure() -> list[Row]:
    rows: list[Row] = []
    for count in COUNTS:
        with TemporaryDirectory() as folder:
            rows += _measure(count, Path(folder))
    return rows


def _measure(count: int, folder: Path) -> list[Row]:
    names = [_name(number) for number in range(count)]
    holders = [Holder(name, "vehicle") for name in names]
    init_site(folder, [*holders, Holder("router", "operator", HOSTS), Holder("anna", "operator")], days=2)
    init_site(folder / "other", [Holder("anna", "operator")], days=2)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    roles = {"viewer": [], "operator": ["anna", "router"], "vehicle": names}
    router_file = folder / "router.yaml"
    router_file.write_text(
        json.dumps(
            {
                "publishing": {
                    "listen": [endpoint],
                    "security": {"tls": _tls(folder, "router"), "roles": roles},
                }
            }
        )
    )
    what = f"{count} vehicles"
    rows: list[Row] = []
    with ExitStack() as opened:
        router = opened.enter_context(_router(router_file))
        began_s = time.monotonic()
        for first in range(0, count, -(-count // PROCESSES)):
            opened.enter_context(
                _vehicles(folder, endpoint, first, min(-(-count // PROCESSES), count - first))
            )
        site = PublishingConfig.model_validate(
            {"connect": [endpoint], "security": {"tls": _tls(folder, "anna")}}
        )
        session = opened.enter_context(connected(site))
        _wait(session, count)
        rows.append((f"{what}: until all are there", time.monotonic() - began_s, "s"))
        rows += [(f"{what}: {name}", value, unit) for name, value, unit in _steady(session, router, count)]
        rows.append((f"{what}: late joiner has all tiles after", _late(site), "s"))
        rows.append((f"{what}: stranger is refused", float(_is_refused(endpoint, folder)), ""))
    if count == COUNTS[0]:
        rows += [
            (f"{what}: {name}", value, unit) for name, value, unit in _away(folder, router_file, site, count)
        ]
    return rows


def _steady(session: zenoh.Session, router: subprocess.Popen[str], count: int) -> list[Row]:
    """With one subscriber for all."""
    got: Counter[str] = Counter()
    lock = threading.Lock()

    def take(sample: zenoh.Sample) -> None:
        with lock:
            got[str(sample.key_expr).split("/")[3]] += 1

    before = _sent(session)
    subscriber = session.declare_subscriber("corridor/v1/**", take)
    time.sleep(2.0)  # until every vehicle knows of it
    with lock:
        got.clear()
    sent, cpu_s, began_s = _sent(session), _cpu_s(router.pid), time.monotonic()
    time.sleep(SECONDS)
    seconds = time.monotonic() - began_s
    with lock:
        heard = got.copy()
    after, spent_s = _sent(session), _cpu_s(router.pid) - cpu_s
    subscriber.undeclare()
    assert len(before) == count
    rates = [(after[name] - sent[name]) / seconds for name in sent]
    return [
        ("poses a vehicle", heard["pose"] / seconds / count, "Hz"),
        ("health a vehicle", heard["health"] / seconds / count, "Hz"),
        ("tiles a vehicle", heard["map"] / seconds / count, "Hz"),
        ("uplink a vehicle, median", float(np.median(rates)) / 1e3, "kB/s"),
        ("uplink a vehicle, most", max(rates) / 1e3, "kB/s"),
        ("messages through the router", heard.total() / seconds, "1/s"),
        ("processor of the router", 100 * spent_s / seconds, "% of a core"),
        ("memory of the router", _rss_mb(router.pid), "MB"),
    ]


def _late(site: PublishingConfig) -> float:
    with connected(site) as session:
        began_s = time.monotonic()
        replies = session.get(
            "corridor/v1/*/map/tile/**?since=0", timeout=60.0, consolidation=zenoh.ConsolidationMode.NONE
        )
        assert sum(reply.ok is not None for reply in replies) > 0
        return time.monotonic() - began_s


def _is_refused(endpoint: str, folder: Path) -> bool:
    strange = {"tls": {**_tls(folder / "other", "anna"), "ca": str(folder / "ca.pem")}}
    config = PublishingConfig.model_validate({"connect": [endpoint], "security": strange})
    try:
        with connected(config):
            return False
    except Exception as error:
        return "no router" in str(error)


def _away(folder: Path, router_file: Path, site: PublishingConfig, count: int) -> list[Row]:
    """The router is gone for a minute: when all vehicles are back, and how much they send then."""
    endpoint = site.connect[0]
    with ExitStack() as opened:
        with _router(router_file):
            for first in range(0, count, -(-count // PROCESSES)):
                opened.enter_context(
                    _vehicles(folder, endpoint, first, min(-(-count // PROCESSES), count - first))
                )
            with connected(site) as session:
                _wait(session, count)
        time.sleep(AWAY_S)
        began_s = time.monotonic()
        opened.enter_context(_router(router_file))
        session = opened.enter_context(connected(site))
        _wait(session, count)
        back_s = time.monotonic() - began_s
        sent = _sent(session)
        time.sleep(5.0)
        after = _sent(session)
        rate = max((after[name] - sent[name]) / 5.0 for name in sent)
        return [
            (f"router away {AWAY_S:.0f} s: all back after", back_s, "s"),
            ("uplink then without a subscriber, most", rate / 1e3, "kB/s"),
        ]


def _wait(session: zenoh.Session, count: int) -> None:
    until_s = time.monotonic() + START_S
    while sum(vehicle.state == "ok" for vehicle in read_vehicles(session)) < count:
        assert time.monotonic() < until_s, f"not {count} vehicles after {START_S:.0f} s"
        time.sleep(0.5)


def _sent(session: zenoh.Session) -> dict[str, int]:
    """Bytes that each vehicle's kernel has sent to the router, as its health says."""
    from service.encoding import decode_diagnostics
    from service.fleet.vehicles import last_of

    found = {}
    for name, sample in last_of(session, "health").items():
        rows = {row.name: row.values for row in decode_diagnostics(sample.payload.to_bytes())}
        found[name] = int(rows["fleet"].get("bytes_sent", "0"))
    return found


@contextmanager
def _router(file: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "service", "fleet", "router", str(file), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def _vehicles(folder: Path, endpoint: str, first: int, count: int) -> Iterator[None]:
    command = [sys.executable, "-m", "tests.bench.fleet", str(folder), endpoint, str(first), str(count)]
    with subprocess.Popen(command) as process:
        try:
            yield
        finally:
            process.kill()


def _drive(folder: Path, endpoint: str, first: int, count: int) -> None:
    """Sinks of vehicles that stand and map, until the process is killed."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    sinks, stores = [], []
    for number in range(first, first + count):
        security = {"tls": _tls(folder, _name(number))}
        config = PublishingConfig.model_validate({"fleet": {"connect": [endpoint]}, "security": security})
        stores.append(TileStore())
        sinks.append(FleetSink(config, sink_context(vehicle=_name(number), tiles=stores[-1])))
        sinks[-1].start()
    random = np.random.default_rng(first)
    filler = Status("devices", OK, "ok", {"text": "x" * HEALTH_BYTES})
    for step in range(1 << 30):
        now_ns = time.time_ns()
        pose = encode_pose(OUTPUT, now_ns)
        for sink, store in zip(sinks, stores, strict=True):
            sink.put(replace(pose, log_ns=now_ns))
            if step % round(POSE_HZ) == 0:
                rows = [Status("mapping", OK, "ok", {"state": "ok"}), sink.health(), filler]
                sink.put(encode_diagnostics("diagnostics", rows, now_ns, now_ns))
            if step % round(2 * POSE_HZ) == 0:
                tiles = [_tile(random, store.version + 1 + k, step) for k in range(TILES_AT_ONCE)]
                store.update(tiles)
                sink.put_tiles(tiles, now_ns, now_ns)
        time.sleep(max(1.0 / POSE_HZ - (time.time_ns() - now_ns) / 1e9, 0.0))


def _tile(random: np.random.Generator, version: int, step: int) -> TileUpdate:
    """A wall a few cells thick, free on one side, unknown on the other."""
    cells = np.full((TILE_CELLS, TILE_CELLS), -1, np.int8)
    wall = int(random.integers(20, 44))
    cells[:wall] = 0
    cells[wall : wall + 3] = random.integers(40, 101, (3, TILE_CELLS), np.int8)
    cells.setflags(write=False)
    return TileUpdate(0, step % 40, version % 40, version, 0.05, cells)


def _name(number: int) -> str:
    return f"veh{number + 1}"


def _tls(folder: Path, name: str) -> dict[str, str]:
    return {"ca": f"{folder}/ca.pem", "certificate": f"{folder}/{name}.pem", "key": f"{folder}/{name}.key"}


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _rss_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    _drive(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
