"""Poses, scans and tiles of a running service, from Zenoh."""

import atexit
import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Generic, Literal, Self, TypeVar, get_args, overload

import numpy as np
import zenoh

from drivers.frames import LaserScan
from drivers.rmw_zenoh import Attachment
from drivers.zenoh_callback import daemon_callback
from drivers.zenoh_config import zenoh_config
from service.api.poses import Pose, pose_in_message
from service.encoding import LASER_SCAN, TILES, decode_frame, decode_grid
from service.errors import CorridorError, InputError, StorageError, UsageError
from service.outputs import TileUpdate
from service.publishing.keys import NAME_RULE, is_name, vehicle_key

log = logging.getLogger(__name__)

What = Literal["pose", "scan", "tile"]
Update = Pose | LaserScan | TileUpdate
UpdateT = TypeVar("UpdateT", bound=Update)

CHANNELS: dict[What, str] = {"pose": "pose", "scan": "*/scan", "tile": f"{TILES}/**"}
CONNECT_S = 10.0
MAX_WAITING = 1000  # poses and scans, the oldest are dropped; 10 s of three lasers
ASK_AGAIN_S = 5.0  # for tiles that a congested link has dropped


class Subscription(Generic[UpdateT]):
    """Iterate it for what the service publishes; the connection ends on leaving `with`, by close, or
    as the interpreter ends.

    The first tiles are those of the map as it is. Of a tile only the newest version waits to be taken; of
    poses and scans the last 1000: `dropped` counts those before. A service that restarts is found again.
    """

    def __init__(
        self, session: zenoh.Session, vehicle: str, what: Sequence[What], timeout_s: float | None
    ) -> None:
        self.dropped = 0
        self._session = session
        self._timeout_s = timeout_s
        self._changed = threading.Condition()  # of all that follows
        self._stream: deque[Any] = deque()
        self._tiles: dict[str, Any] = {}  # by key; the one that waits longest first
        # Of each tile: run of the service, and version in it; metres and number of cells of an edge.
        self._newest: dict[str, tuple[bytes, int, float, int]] = {}
        self._runs: dict[str, set[bytes]] = {}  # of the service, by vehicle
        self._is_tile_next = True
        self._is_closed = False
        self._keys = {one: vehicle_key(vehicle, CHANNELS[one]) for one in what}
        self._ask_at_s = time.monotonic()
        atexit.register(self.close)  # Zenoh's threads would call into an interpreter that ends
        self._subscribers = [
            session.declare_subscriber(key, daemon_callback(self._take, f"subscription-{what}"))
            for what, key in self._keys.items()
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> UpdateT:
        """Wait for the next. Raises CorridorError where none comes in time, StopIteration once closed."""
        until_s = None if self._timeout_s is None else time.monotonic() + self._timeout_s
        while True:
            self._ask_for_tiles()
            with self._changed:
                if (update := self._next()) is not None:
                    return update
                if self._is_closed:
                    raise StopIteration
                left_s = ASK_AGAIN_S if until_s is None else min(until_s - time.monotonic(), ASK_AGAIN_S)
                if left_s <= 0.0:
                    keys = " and ".join(self._keys.values())
                    raise CorridorError(
                        f"nothing came on {keys} for {self._timeout_s:g} s; does the service map, and is "
                        "this its vehicle?"
                    )
                self._changed.wait(left_s)

    def close(self) -> None:
        """End the connection; what waits is still given."""
        with self._changed:
            was_closed, self._is_closed = self._is_closed, True
            self._changed.notify_all()
        if not was_closed:
            atexit.unregister(self.close)
            self._session.close()  # type: ignore[no-untyped-call]

    def _next(self) -> UpdateT | None:
        """Tiles and what streams in turn, so that neither waits for the other."""
        if self._tiles and (self._is_tile_next or not self._stream):
            self._is_tile_next = False
            tile: UpdateT = self._tiles.pop(next(iter(self._tiles)))
            return tile
        self._is_tile_next = True
        return self._stream.popleft() if self._stream else None

    def _ask_for_tiles(self) -> None:
        """For the map as it is at first, later for what has been lost; replies come as samples do."""
        if "tile" in self._keys and not self._is_closed and time.monotonic() >= self._ask_at_s:
            self._ask_at_s = time.monotonic() + ASK_AGAIN_S
            try:
                self._session.get(
                    f"{self._keys['tile']}?since=0",
                    daemon_callback(self._take_reply, "subscription-tiles"),
                    consolidation=zenoh.ConsolidationMode.NONE,
                )
            except zenoh.ZError as error:
                if not self._is_closed:
                    raise StorageError(f"the Zenoh session does not ask for tiles: {error}") from error

    def _take_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._take(reply.ok)

    def _take(self, sample: zenoh.Sample) -> None:
        """Called in threads of their own."""
        try:
            self._add(str(sample.key_expr), sample.payload.to_bytes(), sample.attachment)
        except (InputError, ValueError) as error:
            log.warning("%s: %s", sample.key_expr, error)

    def _add(self, key: str, payload: bytes, attachment: zenoh.ZBytes | None) -> None:
        if f"/{TILES}/" in key:
            beside = Attachment.decode(b"" if attachment is None else attachment.to_bytes())
            self._add_tile(key, payload, beside.sequence, beside.gid)
            return
        update = pose_in_message(payload) if key.endswith("/pose") else _scan(key, payload)
        if update is None:
            raise InputError("a scan without content that can be used")
        with self._changed:
            if len(self._stream) >= MAX_WAITING:
                self._stream.popleft()
                self.dropped += 1
            self._stream.append(update)
            self._changed.notify()

    def _add_tile(self, key: str, payload: bytes, version: int, run: bytes) -> None:
        with self._changed:
            newest = self._newest.get(key)
            if newest is not None and newest[0] == run and version <= newest[1]:
                return
            grid, place = decode_grid(payload), _place(key)
            self._empty_former(key.partition(f"/{TILES}/")[0], run)
            self._newest[key] = run, version, grid.cell_m, len(grid.cells)
            self._tiles[key] = TileUpdate(*place, version, grid.cell_m, grid.cells)
            self._changed.notify()

    def _empty_former(self, vehicle: str, run: bytes) -> None:
        """Where the service was started again: the tiles of its run before are those of another map. Under
        the lock.
        """
        runs = self._runs.setdefault(vehicle, set())
        if run in runs:
            return
        if runs:
            self._ask_at_s = time.monotonic()
            for key in [key for key in self._newest if key.startswith(f"{vehicle}/")]:
                *_, cell_m, edge = self._newest.pop(key)
                unknown = np.full((edge, edge), -1, np.int8)
                self._tiles[key] = TileUpdate(*_place(key), 0, cell_m, unknown)
        runs.add(run)


@overload
def subscribe(
    endpoint: str | zenoh.Session, what: Literal["pose"], *, vehicle: str = ..., timeout_s: float | None = ...
) -> Subscription[Pose]: ...
@overload
def subscribe(
    endpoint: str | zenoh.Session, what: Literal["scan"], *, vehicle: str = ..., timeout_s: float | None = ...
) -> Subscription[LaserScan]: ...
@overload
def subscribe(
    endpoint: str | zenoh.Session, what: Literal["tile"], *, vehicle: str = ..., timeout_s: float | None = ...
) -> Subscription[TileUpdate]: ...
@overload
def subscribe(
    endpoint: str | zenoh.Session,
    what: Sequence[What] = ...,
    *,
    vehicle: str = ...,
    timeout_s: float | None = ...,
) -> Subscription[Update]: ...
def subscribe(
    endpoint: str | zenoh.Session,
    what: What | Sequence[What] = ("pose", "scan", "tile"),
    *,
    vehicle: str = "*",
    timeout_s: float | None = 30.0,
) -> Subscription[Any]:
    """Connect to a running service: `for update in corridor.subscribe("tcp/127.0.0.1:7447")`.

    endpoint    as publishing.listen of its config; or an open Zenoh session, where TLS or a password is
                needed, which `close` then closes
    what        "pose", "scan", "tile", or several
    vehicle     name of the vehicle; "*": every one that the endpoint knows
    timeout_s   how long to wait for the next before an error; None: for ever

    Raises StorageError where nothing answers at the endpoint, UsageError.
    """
    chosen: Sequence[What] = [what] if isinstance(what, str) else what
    if unknown := [one for one in chosen if one not in get_args(What)]:
        raise UsageError(f"{unknown[0]!r} cannot be subscribed to; take {', '.join(get_args(What))}")
    if not chosen:
        raise UsageError(f"nothing is subscribed to; take {', '.join(get_args(What))}")
    if vehicle != "*" and not is_name(vehicle):
        raise UsageError(f"{vehicle!r} is no name of a vehicle; it takes {NAME_RULE}")
    session = _connect(endpoint) if isinstance(endpoint, str) else endpoint
    return Subscription(session, vehicle, chosen, timeout_s)


def _connect(endpoint: str) -> zenoh.Session:
    settings = {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": round(1e3 * CONNECT_S),
        "transport/shared_memory/enabled": False,
    }
    try:
        return zenoh.open(zenoh_config(settings))
    except zenoh.ZError as error:
        raise StorageError(
            f"no service answers at {endpoint} within {CONNECT_S:.0f} s; expected its publishing.listen, "
            "such as tcp/127.0.0.1:7447"
        ) from error


def _place(key: str) -> tuple[int, int, int]:
    """Level, ix, iy of a tile."""
    level, ix, iy = map(int, key.rsplit("/", 3)[1:])
    return level, ix, iy


def _scan(key: str, payload: bytes) -> LaserScan | None:
    sensor = key.split("/")[-2]
    frame = decode_frame(LASER_SCAN, payload, sensor, time.time_ns())
    return frame if isinstance(frame, LaserScan) else None
