"""One process of vehicles for the fleet's bench, each with a link, a certificate and a session of its own.

`python -m tests.bench.fleet_vehicles SITE ENDPOINT FIRST COUNT [RECORDING...]`: vehicles that map the
recordings at real time, each beginning with another one; without any, vehicles that stand and send.
"""

import resource
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count as count_up
from pathlib import Path

import numpy as np

from drivers.frames import LaserScan
from service.encoding import LEVEL_OF_STATE, OK, Status, encode_diagnostics, encode_pose
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.mapstore.tiles import TileStore
from service.offline.past.past_page import ShownTiles
from service.offline.replay.pace import Pace
from service.offline.replay.replay import replay
from service.offline.replay.setup import ReplayOptions
from service.outputs import MapperOutput, TileUpdate
from service.publishing.config import PublishingConfig
from service.recording.mcap_source import Session
from service.sinks.fleet_sink import FleetSink
from tests.service.sinks.contexts import sink_context
from tests.service.test_encoding_outputs import OUTPUT

POSE_HZ = 12.5  # of the slowest laser; the policy lets 5 through
TILES_S, HEALTH_S = 2.0, 1.0
TILE_CELLS, TILES_AT_ONCE = 64, 2  # of a map that grows: 3.2 m of wall each, every 2 s
HEALTH_BYTES = 6000  # of a vehicle with three devices
FILLER = Status("devices", OK, "ok", {"text": "x" * HEALTH_BYTES})


def name_of(number: int) -> str:
    return f"veh{number + 1}"


def tls_of(folder: Path, name: str) -> dict[str, str]:
    return {"ca": f"{folder}/ca.pem", "certificate": f"{folder}/{name}.pem", "key": f"{folder}/{name}.key"}


class Vehicle:
    """A link to the fleet, and the tiles that it answers with."""

    def __init__(self, folder: Path, endpoint: str, number: int) -> None:
        name = name_of(number)
        security = {"tls": tls_of(folder, name)}
        config = PublishingConfig.model_validate({"fleet": {"connect": [endpoint]}, "security": security})
        self.store = TileStore()
        self.sink = FleetSink(config, sink_context(vehicle=name, tiles=self.store))
        self.sink.start()

    def send_health(self, mapping: Status) -> None:
        now_ns = time.time_ns()
        rows = [mapping, self.sink.health(), FILLER]
        self.sink.put(encode_diagnostics("diagnostics", rows, now_ns, now_ns))


class Mapping1x:
    """A Watch that sends poses and tiles at the rate of the recording."""

    def __init__(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._shown = ShownTiles(vehicle.store)
        self._mapper: MappingSession | None = None
        self._pace, self._due_s = Pace(1.0), 0.0
        self._health_due_s = self._tiles_due_s = 0.0

    def begin(self, session: Session, mapper: MappingSession, poses_base_sensor: Mapping[str, SE2]) -> None:
        self._mapper, self._pace = mapper, Pace(1.0)
        self._due_s = time.monotonic() - session.recording.first_log_ns / 1e9

    def wait_for(self, log_ns: int) -> None:
        self._pace.wait_for(log_ns)

    def mapped(self, scan: LaserScan, output: MapperOutput) -> None:
        now_s = time.monotonic()
        self._vehicle.sink.put(replace(encode_pose(output, scan.arrived_ns), log_ns=time.time_ns()))
        if now_s >= self._health_due_s:
            self._health_due_s = now_s + HEALTH_S
            behind_s = now_s - self._due_s - scan.arrived_ns / 1e9
            values = {"state": output.state, "behind_s": f"{behind_s:.3f}"}
            self._vehicle.send_health(Status("mapping", LEVEL_OF_STATE[output.state], output.reason, values))
        if now_s >= self._tiles_due_s:
            self._tiles_due_s = now_s + TILES_S
            before = self._vehicle.store.version
            self._shown.take(self._mapper.tiles())
            self._vehicle.sink.put_tiles(self._vehicle.store.since(before), output.stamp_ns, time.time_ns())

    def closing(self) -> None: ...

    def finished(self, tiles: Sequence[TileUpdate], poses_map_base: Sequence[SE2]) -> None: ...


def _map(vehicle: Vehicle, recordings: Sequence[Path], first: int) -> None:
    """One recording after the other, each a map of its own, until the process is killed."""
    watch = Mapping1x(vehicle)
    for k in count_up(first):
        replay([recordings[k % len(recordings)]], ReplayOptions(rate=1.0), watch=watch)


def _stand(vehicles: Sequence[Vehicle], seed: int) -> None:
    """Poses and tiles of vehicles that stand, until the process is killed."""
    random = np.random.default_rng(seed)
    for step in count_up():
        now_ns = time.time_ns()
        pose = encode_pose(OUTPUT, now_ns)
        for vehicle in vehicles:
            vehicle.sink.put(replace(pose, log_ns=now_ns))
            if step % round(POSE_HZ * HEALTH_S) == 0:
                vehicle.send_health(Status("mapping", OK, "ok", {"state": "ok", "behind_s": "0"}))
            if step % round(POSE_HZ * TILES_S) == 0:
                first = vehicle.store.version + 1
                tiles = [_tile(random, first + k, step) for k in range(TILES_AT_ONCE)]
                vehicle.store.update(tiles)
                vehicle.sink.put_tiles(tiles, now_ns, now_ns)
        time.sleep(max(1.0 / POSE_HZ - (time.time_ns() - now_ns) / 1e9, 0.0))


def _tile(random: np.random.Generator, version: int, step: int) -> TileUpdate:
    """A wall a few cells thick, free on one side, unknown on the other."""
    cells = np.full((TILE_CELLS, TILE_CELLS), -1, np.int8)
    wall = int(random.integers(20, 44))
    cells[:wall] = 0
    cells[wall : wall + 3] = random.integers(40, 101, (3, TILE_CELLS), np.int8)
    cells.setflags(write=False)
    return TileUpdate(0, step % 40, version % 40, version, 0.05, cells)


def main(folder: Path, endpoint: str, first: int, count: int, recordings: Sequence[Path]) -> None:
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    vehicles = [Vehicle(folder, endpoint, number) for number in range(first, first + count)]
    if not recordings:
        _stand(vehicles, first)
    threads = [
        threading.Thread(target=_map, args=(vehicle, recordings, number), name=name_of(number))
        for number, vehicle in enumerate(vehicles, first)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


if __name__ == "__main__":
    site, endpoint, first, count, *recordings = sys.argv[1:]
    main(Path(site), endpoint, int(first), int(count), [Path(one) for one in recordings])
