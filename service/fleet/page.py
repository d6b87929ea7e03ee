"""All vehicles of a site on one map, on the operator's page."""

import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import zenoh

from drivers.counted import counted
from drivers.rmw_zenoh import Attachment
from drivers.zenoh_callback import daemon_callback
from service.encoding import ERROR, OK, TILES, WARNING, Status, decode_grid, encode_diagnostics
from service.errors import InputError
from service.fleet.vehicles import ANSWER_S, Vehicle, vehicle_in
from service.fleet.watch import Watch
from service.mapstore.files import load_map
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.publishing.commands import Answer, refusal
from service.publishing.keys import vehicle_key
from service.web.access import new_token
from service.web.config import WebConfig
from service.web.protocol import to_json
from service.web.server import About, WebServer, start_serving

log = logging.getLogger(__name__)

POSES_S = 0.2
HEALTH_S = 1.0
CLOSE_S = 5.0


class FleetPage:
    """Served from construction until `close`.

    site_map   folder of a stored map, in which all vehicles are; None: the tiles that they send, of each
               place the newest

    Raises InputError where there is no map in it, StorageError where the page cannot be served.
    """

    def __init__(self, session: zenoh.Session, listen: str, site_map: Path | None = None) -> None:
        self._session = session
        self.store = TileStore()
        self._adding = threading.Lock()
        self.versions: dict[str, int] = {}  # newest tile of each vehicle
        if site_map is not None:
            self.store.update(load_map(site_map).tiles)
        self._follows_tiles = site_map is None
        self.vehicles: dict[str, Vehicle] = {}
        self._watch = Watch(session)
        self._ending = threading.Event()
        about = About("fleet", "fleet", tuple)
        self._server = WebServer(
            WebConfig(listen=listen), about, self.store, _refuse, new_token(), retry_s=None
        )
        self._show_health()
        start_serving(self._server)
        if self._follows_tiles:
            taken = daemon_callback(self._take, "fleet-tiles")
            session.declare_subscriber(vehicle_key("*", f"{TILES}/**"), taken)
        works: dict[str, Callable[[], None]] = {
            "watch": partial(self._watch.run, self._came, None, changes_only=False),
            "show": self._show,
        }
        self._threads = [
            threading.Thread(target=work, name=f"fleet-{name}", daemon=True) for name, work in works.items()
        ]
        for thread in self._threads:
            thread.start()

    @property
    def address(self) -> str:
        return self._server.address

    def close(self) -> None:
        self._ending.set()
        self._watch.close()
        for thread in self._threads:
            thread.join(CLOSE_S)
        self._server.close()

    def _came(self, vehicle: Vehicle) -> None:
        """One that is here again is queried for the tiles that changed meanwhile."""
        before = self.vehicles.get(vehicle.name)
        self.vehicles[vehicle.name] = vehicle
        if self._follows_tiles and vehicle.sessions and (before is None or not before.sessions):
            since = self.versions.get(vehicle.name, 0)
            replies = self._session.get(
                vehicle_key(vehicle.name, f"{TILES}/**?since={since}"),
                timeout=ANSWER_S,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            for reply in replies:
                if reply.ok is not None:
                    self._take(reply.ok)

    def _take(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        try:
            level, ix, iy = map(int, key.split("/")[-3:])
            grid = decode_grid(sample.payload.to_bytes())
            attachment = sample.attachment
            version = Attachment.decode(attachment.to_bytes()).sequence if attachment is not None else 0
        except (InputError, ValueError) as error:
            log.warning("%s is no tile: %s", key, error)
            return
        name = vehicle_in(key)
        with self._adding:
            self.versions[name] = max(self.versions.get(name, 0), version)
            tile = TileUpdate(level, ix, iy, self.store.version + 1, grid.cell_m, grid.cells)
            self.store.update([tile])

    def _show(self) -> None:
        health_at_s = 0.0
        while not self._ending.wait(POSES_S):
            shown = []
            for name, vehicle in sorted(self.vehicles.copy().items()):
                if (at := self._watch.pose(name)) is not None:
                    place = {"x_m": at[0], "y_m": at[1], "theta_rad": at[2]}
                    shown.append({"name": name, **place, "is_well": vehicle.is_well, "state": vehicle.state})
            self._server.put_ready({"vehicles": to_json("vehicles", vehicles=shown)})
            if time.monotonic() >= health_at_s:
                health_at_s = time.monotonic() + HEALTH_S
                self._show_health()

    def _show_health(self) -> None:
        vehicles = sorted(self.vehicles.copy().values(), key=lambda vehicle: vehicle.name)
        well = sum(vehicle.is_well for vehicle in vehicles)
        words = f"{counted(len(vehicles), 'vehicle')}, {well} of them well" if vehicles else "no vehicle yet"
        level = OK if well == len(vehicles) else WARNING
        rows = [Status("mapping", level, words, {"state": "fleet"}), *map(_row, vehicles)]
        now_ns = time.time_ns()
        self._server.put(encode_diagnostics("diagnostics", rows, now_ns, now_ns))


def _row(vehicle: Vehicle) -> Status:
    level = ERROR if not vehicle.is_well else WARNING if vehicle.faults else OK
    words = vehicle.reason if vehicle.reason not in ("", vehicle.state) else ""
    values = {
        "map": vehicle.map,
        "map_version": _text(vehicle.map_version),
        "free_gb": _text(vehicle.free_gb),
        "corridor": vehicle.corridor,
        "faults": "; ".join(vehicle.faults),
        "sessions": "; ".join(vehicle.sessions),
    }
    return Status(f"vehicle/{vehicle.name}", level, ": ".join(filter(None, (vehicle.state, words))), values)


def _text(value: float | None) -> str:
    return "" if value is None else f"{value:g}"


def _refuse(verb: str, payload: bytes) -> Answer:
    return refusal("this page shows the fleet; a vehicle is commanded on its own page")
