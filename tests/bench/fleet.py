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

from service.encoding import OK, Status, decode_diagnostics, encode_diagnostics, encode_pose
from service.fleet.vehicles import Vehicle, connected, last_of
from service.fleet.watch import Watch
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
QUIET_S = 5.0  # no event to await: a subscriber would be sent to
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
        opened.enter_context(_vehicles(folder, endpoint, count))
        site = PublishingConfig.model_validate(
            {"connect": [endpoint], "security": {"tls": _tls(folder, "anna")}}
        )
        session = opened.enter_context(connected(site))
        _wait(site, count)
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
    vehicles: set[str] = set()
    lock, all_send = threading.Lock(), threading.Event()

    def take(sample: zenoh.Sample) -> None:
        _, _, vehicle, channel, *_ = str(sample.key_expr).split("/")
        with lock:
            got[channel] += 1
            vehicles.add(vehicle)
            if len(vehicles) == count:
                all_send.set()

    before = _sent(session)
    subscriber = session.declare_subscriber("corridor/v1/**", take)
    assert all_send.wait(START_S), f"{len(vehicles)} of {count} vehicles send after {START_S:.0f} s"
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
            opened.enter_context(_vehicles(folder, endpoint, count))
            _wait(site, count)
        time.sleep(AWAY_S)
        began_s = time.monotonic()
        opened.enter_context(_router(router_file))
        _wait(site, count)
        back_s = time.monotonic() - began_s
        session = opened.enter_context(connected(site))
        sent, began_s = _sent(session), time.monotonic()
        time.sleep(QUIET_S)
        seconds, after = time.monotonic() - began_s, _sent(session)
        rate = max(after[name] - sent[name] for name in sent) / seconds
        return [
            (f"router away {AWAY_S:.0f} s: all back after", back_s, "s"),
            ("uplink then without a subscriber, most", rate / 1e3, "kB/s"),
        ]


def _wait(site: PublishingConfig, count: int) -> None:
    """Until so many vehicles are well, by a client of its own: what it subscribes to ends with it."""
    well: set[str] = set()
    with connected(site) as session:
        watch = Watch(session)

        def show(vehicle: Vehicle) -> None:
            (well.add if vehicle.state == "ok" else well.discard)(vehicle.name)
            if len(well) == count:
                watch.close()

        watch.run(show, START_S, changes_only=False)
    assert len(well) == count, f"{len(well)} of {count} vehicles are well after {START_S:.0f} s"


def _sent(session: zenoh.Session) -> dict[str, int]:
    """Bytes that each vehicle's kernel has sent to the router, as its health says."""
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
def _vehicles(folder: Path, endpoint: str, count: int) -> Iterator[None]:
    each = -(-count // PROCESSES)
    command = [sys.executable, "-m", "tests.bench.fleet", str(folder), endpoint]
    processes = [
        subprocess.Popen([*command, str(first), str(min(each, count - first))])
        for first in range(0, count, each)
    ]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


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
