"""Many vehicles at one router over TLS on loopback: bytes of each link, work of the router, a late
subscriber, a restarted router, a client of another CA. 20 vehicles map recordings at real time; 100 stand.
"""

import json
import math
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import zenoh

from service.encoding import decode_diagnostics
from service.fleet.vehicles import Vehicle, connected, last_of
from service.fleet.watch import Watch
from service.offline.security.authority import Holder, init_site
from service.publishing.config import PublishingConfig
from simulators.worlds import WORLDS
from tests.bench.fleet_vehicles import name_of, tls_of
from tests.processes import look_at, resident_mb
from tests.recorded_drive import record
from tests.service.recording.sessions import T0_NS
from tests.simulated import FORWARD, LMS100_50HZ, Wheels, drive
from tests.system.machine import free_port

MAPPING, STANDING = 20, 100  # vehicles
WORLDS_DRIVEN, DRIVE_S = ("office", "ring", "library", "floor"), 240.0
LASER = replace(LMS100_50HZ, rate_hz=25.0, every=2)
POLICY_HZ = {"pose": 5.0, "health": 1.0, "map": math.inf}  # at most, and no other channel
PROCESSES = 4
SECONDS = 20.0
AWAY_S = 60.0
QUIET_S = 5.0  # no event to await: a subscriber would be sent to
START_S = 120.0
HOSTS = ("127.0.0.1", "localhost")
Row = tuple[str, float, str]


def measure() -> list[Row]:
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        recordings = [_record(world, folder) for world in WORLDS_DRIVEN]
        rows = _measure(MAPPING, folder / "mapping", recordings)
        return rows + _measure(STANDING, folder / "standing", [])


def _record(world: str, folder: Path) -> Path:
    made = drive(WORLDS[world](), LASER, DRIVE_S, 11, Wheels())
    return record(made.frames, {"front": FORWARD}, folder / world, T0_NS).rename(folder / f"{world}.mcap")


def _measure(count: int, folder: Path, recordings: Sequence[Path]) -> list[Row]:
    """recordings   that the vehicles map, at real time; none: they stand, and no router is ended"""
    names = [name_of(number) for number in range(count)]
    holders = [Holder(name, "vehicle") for name in names]
    init_site(folder, [*holders, Holder("router", "operator", HOSTS), Holder("anna", "operator")], days=2)
    init_site(folder / "other", [Holder("anna", "operator")], days=2)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    roles = {"viewer": [], "operator": ["anna", "router"], "vehicle": names}
    security = {"tls": tls_of(folder, "router"), "roles": roles}
    router_file = folder / "router.yaml"
    router_file.write_text(json.dumps({"publishing": {"listen": [endpoint], "security": security}}))
    site = PublishingConfig.model_validate(
        {"connect": [endpoint], "security": {"tls": tls_of(folder, "anna")}}
    )
    rows: list[Row] = []
    with _vehicles(folder, endpoint, count, recordings):
        with _router(router_file) as router, connected(site) as session:
            began_s = time.monotonic()
            _wait(site, count)
            rows.append(("until all are there", time.monotonic() - began_s, "s"))
            rows += _steady(session, router, count)
            rows.append(("late joiner has all tiles after", _late(site, count), "s"))
            rows.append(("client of another CA is refused", float(_is_refused(endpoint, folder)), ""))
        if recordings:
            rows += _away(router_file, site, count)
    return [(f"{count} vehicles: {name}", value, unit) for name, value, unit in rows]


def _steady(session: zenoh.Session, router: subprocess.Popen[str], count: int) -> list[Row]:
    """With one subscriber for all. Raises AssertionError where a vehicle sends more than its policy says."""
    got: Counter[tuple[str, str]] = Counter()  # vehicle and channel
    lock, all_send = threading.Lock(), threading.Event()

    def take(sample: zenoh.Sample) -> None:
        _, _, vehicle, channel, *_ = str(sample.key_expr).split("/")
        with lock:
            got[vehicle, channel] += 1
            if len({vehicle for vehicle, _ in got}) == count:
                all_send.set()

    before = _sent(session)
    subscriber = session.declare_subscriber("corridor/v1/**", take)
    assert all_send.wait(START_S), f"not all of {count} vehicles send after {START_S:.0f} s: {dict(got)}"
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
    rows: list[Row] = []
    for channel, policy_hz in POLICY_HZ.items():
        rates = [number / seconds for (_, of), number in heard.items() if of == channel]
        assert max(rates, default=0.0) <= policy_hz * (1.0 + 1.0 / SECONDS), (channel, rates)
        rows.append((f"{channel}, mean of the vehicles", sum(rates) / count, "Hz"))
        rows.append((f"{channel}, most", max(rates, default=0.0), "Hz"))
    assert {channel for _, channel in heard} <= POLICY_HZ.keys(), heard
    rates = [(after[name] - sent[name]) / seconds for name in sent]
    return [
        *rows,
        ("uplink a vehicle, median", float(np.median(rates)) / 1e3, "kB/s"),
        ("uplink a vehicle, most", max(rates) / 1e3, "kB/s"),
        ("messages through the router", heard.total() / seconds, "1/s"),
        ("processor of the router", 100 * spent_s / seconds, "% of a core"),
        ("memory of the router", resident_mb(router.pid), "MB"),
        ("mapping behind real time, most", max(_values(session, "mapping", "behind_s").values()), "s"),
    ]


def _late(site: PublishingConfig, count: int) -> float:
    with connected(site) as session:
        began_s = time.monotonic()
        replies = session.get(
            "corridor/v1/*/map/tile/**?since=0", timeout=60.0, consolidation=zenoh.ConsolidationMode.NONE
        )
        of = {str(reply.ok.key_expr).split("/")[2] for reply in replies if reply.ok is not None}
        assert len(of) == count, f"tiles of {len(of)} vehicles, not of {count}"
        return time.monotonic() - began_s


def _is_refused(endpoint: str, folder: Path) -> bool:
    foreign = {"tls": {**tls_of(folder / "other", "anna"), "ca": str(folder / "ca.pem")}}
    config = PublishingConfig.model_validate({"connect": [endpoint], "security": foreign})
    try:
        with connected(config):
            return False
    except Exception as error:
        return "no router" in str(error)


def _away(router_file: Path, site: PublishingConfig, count: int) -> list[Row]:
    """The router is down for a minute: when all vehicles are back, and how much they send then."""
    time.sleep(AWAY_S)
    began_s = time.monotonic()
    with _router(router_file):
        _wait(site, count)
        back_s = time.monotonic() - began_s
        with connected(site) as session:
            sent, began_s = _sent(session), time.monotonic()
            time.sleep(QUIET_S)
            seconds, after = time.monotonic() - began_s, _sent(session)
            behind = _values(session, "mapping", "behind_s")
    rate = max(after[name] - sent[name] for name in sent) / seconds
    assert max(behind.values()) < 2.0, f"mapping waits for the link: {behind}"
    return [
        (f"router away {AWAY_S:.0f} s: all back after", back_s, "s"),
        ("uplink then without a subscriber, most", rate / 1e3, "kB/s"),
        ("mapping behind real time then, most", max(behind.values()), "s"),
    ]


def _wait(site: PublishingConfig, count: int) -> None:
    """Until so many vehicles are ok, by a client of its own: its subscriptions end with it."""
    well: set[str] = set()
    with connected(site) as session:
        watch = Watch(session)

        def show(vehicle: Vehicle) -> None:
            (well.add if vehicle.is_well else well.discard)(vehicle.name)
            if len(well) == count:
                watch.close()

        watch.run(show, START_S, changes_only=False)
    assert len(well) == count, f"{len(well)} of {count} vehicles are well after {START_S:.0f} s"


def _sent(session: zenoh.Session) -> dict[str, float]:
    """Bytes that each vehicle's kernel has sent to the router, from its health."""
    return _values(session, "fleet", "bytes_sent")


def _values(session: zenoh.Session, row: str, key: str) -> dict[str, float]:
    """A value in the last health of each vehicle; 0 where it is absent."""
    found = {}
    for name, sample in last_of(session, "health").items():
        rows = {row.name: row.values for row in decode_diagnostics(sample.payload.to_bytes())}
        found[name] = float(rows[row].get(key, "0"))
    return found


@contextmanager
def _router(file: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "service", "fleet", "router", str(file), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline()
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def _vehicles(folder: Path, endpoint: str, count: int, recordings: Sequence[Path]) -> Iterator[None]:
    each = -(-count // PROCESSES)
    command = [sys.executable, "-m", "tests.bench.fleet_vehicles", str(folder), endpoint]
    processes = [
        subprocess.Popen([*command, str(first), str(min(each, count - first)), *map(str, recordings)])
        for first in range(0, count, each)
    ]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _cpu_s(pid: int) -> float:
    process = look_at(pid)
    return process.cpu_s
