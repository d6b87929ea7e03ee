"""A vehicle in its fleet, as a sink: poses, health and changed tiles to a router of the site."""

import logging
import socket
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace

import zenoh

from drivers.zenoh_callback import daemon_callback
from service.encoding import ERROR, OK, TILES, WARNING, Message, Status
from service.errors import StorageError
from service.outputs import TileUpdate, reason_value
from service.publishing.certificate import validity_of
from service.publishing.config import PublishingConfig, host_of
from service.publishing.keys import alive_key, vehicle_key
from service.publishing.listeners import Listeners
from service.publishing.shared import SharedZenoh
from service.publishing.uplink import LinkBytes, Presence, open_uplink, presences
from service.publishing.zenoh_publisher import ZenohPublisher
from service.sinks.fleet_files import FleetFiles
from service.sinks.fleet_journal import FleetJournal
from service.sinks.sink import Sink, SinkContext
from service.sinks.zenoh_sink import alive_components
from service.version import VERSION

log = logging.getLogger(__name__)

LOOK_S = 1.0
RETRY_S = (0.5, 30.0)  # until the first link; a lost one Zenoh itself brings back
CHANNELS = {"pose": "pose", "diagnostics": "health"}  # and nothing else but tiles
JOURNAL_FILE = "fleet.sqlite"  # beside the recordings
JOIN_S = 8.0  # a try to connect takes 3 s


def open_sink(config: PublishingConfig, context: SinkContext) -> "FleetSink | None":
    return FleetSink(config, context) if config.fleet.connect else None


class FleetSink(Sink):
    """Connects from `start` on, in a thread that nothing waits for.

    Of two vehicles by one name the one that was there first is in the fleet, whatever their clocks say; the
    other is refused while it is. Of two that come at once it is the one that began first by its own clock.
    """

    name = "fleet"

    def __init__(self, config: PublishingConfig, context: SinkContext) -> None:
        self._config = config.model_copy(update={"listen": (), "connect": config.fleet.connect})
        self._context = context
        self._began_ns = time.time_ns()
        self._shared = SharedZenoh(open_uplink)
        self._publisher: ZenohPublisher | None = None
        self._opened = ExitStack()  # beside it
        self._followers: Listeners | None = None  # of tiles, which Zenoh would send without any, too
        recordings = context.folders.get("recording")
        self._journal = FleetJournal(recordings / JOURNAL_FILE) if recordings is not None else None
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._fault = "not connected yet"
        self._rival: Presence | None = None  # that was first
        self._refused: Presence | None = None  # that is refused for this vehicle
        self._bytes = LinkBytes()
        self._rate_from = (time.monotonic(), 0)
        self._values: dict[str, str] = {}

    def start(self) -> None:
        self._thread.start()

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        publisher, channel = self._publisher, CHANNELS.get(message.channel)
        if channel is not None and self._journal is not None:
            (self._journal.health if channel == "health" else self._journal.pose)(message)
        if publisher is None or channel is None:
            return
        if channel == "health":
            publisher.show_alive(alive_components(message, self._context.links))
        publisher.put(replace(message, channel=channel))

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        if (publisher := self._publisher) is not None and self._config.fleet.tiles:
            followed = self._followers is not None and self._followers.are_there
            publisher.map_changed(tiles if followed else (), stamp_ns, log_ns)  # later they are queried

    def health(self) -> Status:
        fault = self._fault  # before the values, which are written before it
        fault = fault or (self._journal.fault if self._journal is not None else "")
        values = {"corridor": VERSION, "map_version": str(self._context.tiles.version), **self._values}
        if publisher := self._publisher:
            for what, counter in publisher.counts().items():
                values |= {f"{what}.{channel}": str(count) for channel, count in sorted(counter.items())}
        if (rival := self._rival) is not None:
            return Status(self.name, ERROR, self._refusal(rival), values | reason_value("name_taken"))
        if (refused := self._refused) is not None and not self._fault:
            reason = reason_value("name_taken")
            return Status(self.name, WARNING, self._refusal(None, refused), values | reason)
        if fault:
            reason = reason_value("no_router" if self._fault else "disk_error")
            return Status(self.name, WARNING, fault, values | reason)
        return Status(self.name, OK, "ok", values)

    def place(self) -> str:
        return ", ".join(self._config.connect)

    def close(self) -> None:
        self._closing = True
        self._wake.set()
        if self._thread.ident is not None:
            self._thread.join(JOIN_S)
            if self._thread.is_alive():
                log.error("fleet: Zenoh does not close after %.0f s; left behind", JOIN_S)

    def _run(self) -> None:
        session = self._connected()
        if session is not None:
            try:
                self._stay(session)
            finally:
                self._withdraw()
                self._shared.close()
        self._write_journal()

    def _connected(self) -> zenoh.Session | None:
        """None where the service ends before."""
        pause_s = RETRY_S[0]
        while not self._closing:
            try:
                return self._shared.open(self._config)
            except StorageError as error:
                if str(error) != self._fault:
                    log.warning("fleet: %s; tried again and again", error)
                self._fault = str(error)
            self._write_journal()
            self._wake.wait(pause_s)
            pause_s = min(2 * pause_s, RETRY_S[1])
        return None

    def _stay(self, session: zenoh.Session) -> None:
        token: zenoh.LivelinessToken | None = None
        own = Presence(0, "", "", "")
        watched = alive_key(self._context.vehicle, "fleet/**")
        changed: zenoh.handlers.Callback[zenoh.Sample] = daemon_callback(
            lambda sample: self._wake.set(), "fleet-presence"
        )
        session.liveliness().declare_subscriber(watched, changed)
        self._followers = Listeners(session, vehicle_key(self._context.vehicle, f"{TILES}/**"), lambda: None)
        host, decided_for = socket.gethostname() or "unnamed", ""
        while not self._closing:
            links = session.info.links()
            source = links[0].src if links else ""
            self._look(links[0].dst if links else "", source)
            if source and (token is None or host_of(source) != own.address):
                if token is None:
                    others = self._others(session, own, watched)
                    self._began_ns = max([self._began_ns, *(other.began_ns + 1 for other in others)])
                before, own = token, Presence(self._began_ns, str(session.zid()), host, host_of(source))
                token = session.liveliness().declare_token(own.key(self._context.vehicle))
                if before is not None:
                    before.undeclare()  # type: ignore[no-untyped-call]
            if self._wake.is_set():  # decided again once there is a link
                self._wake.clear()
                decided_for = ""
            if source and source != decided_for:
                self._decide(session, own, watched)
                decided_for = source
            self._write_journal()
            self._wake.wait(LOOK_S)

    def _write_journal(self) -> None:
        if self._journal is not None:
            self._journal.write()

    def _look(self, router: str, source: str) -> None:
        self._bytes.look(source)
        now_s = time.monotonic()
        before_s, sent = self._rate_from
        values = {"router": router, "address": source, "links": str(self._bytes.links)}
        values |= {"bytes_sent": str(self._bytes.sent), "bytes_received": str(self._bytes.received)}
        if now_s - before_s >= LOOK_S / 2:
            self._rate_from = now_s, self._bytes.sent
            values["kilobytes_per_s"] = f"{(self._bytes.sent - sent) / (now_s - before_s) / 1e3:.1f}"
        self._values = {**self._values, **values}
        own = "" if router else validity_of(self._config.secured).fault()  # as it is read for the next link
        lost = f"no link to {self.place()}; poses and tiles stay on this machine{own and '; '}{own}"
        self._fault = "" if router else lost

    def _decide(self, session: zenoh.Session, own: Presence, watched: str) -> None:
        """Be in the fleet, unless another one of this name was first."""
        rival = min(self._others(session, own, watched), default=None)
        self._values["own"] = str(own)
        if rival is None or own < rival:
            if rival is not None and rival != self._refused:
                log.warning("fleet: %s", self._refusal(None, rival))
            self._rival, self._refused = None, rival
            if self._publisher is None:
                self._appear(session)
            return
        if self._rival != rival:
            self._rival, self._refused = rival, None
            log.error("fleet: %s", self._refusal(rival))
        self._withdraw()

    def _others(self, session: zenoh.Session, own: Presence, watched: str) -> list[Presence]:
        """Further sessions by this vehicle's name."""
        replies = session.liveliness().get(watched, timeout=10.0)  # on a busy machine 2 s are too few
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        others = presences(keys).get(self._context.vehicle, ())
        return [who for who in others if who.session != own.session]

    def _refusal(self, first: Presence | None, refused: Presence | None = None) -> str:
        """None: this vehicle."""
        name, own = self._context.vehicle, self._values.get("own", "this one")
        who = f"{first or own} was first, {refused or own} is refused"
        return f"two vehicles are called {name}: {who}; give one another name"

    def _appear(self, session: zenoh.Session) -> None:
        publisher = ZenohPublisher(
            self._config,
            self._context.vehicle,
            self._context.tiles,
            shared=self._shared,
            tile_period_s=self._config.fleet.tile_period_s,
            pictures=("map/meta",) if self._config.fleet.tiles else (),
            name=self.name,
            tiles_wait=True,
        )
        if self._config.fleet.commands:
            publisher.answer_commands(self._context.command)
            folders = self._context.folders
            places = folders.get("recording"), folders.get("map"), self._journal
            files = FleetFiles(session, self._context.vehicle, *places)
            self._opened.callback(files.close)
        self._publisher = publisher

    def _withdraw(self) -> None:
        publisher, self._publisher = self._publisher, None
        self._opened.close()
        if publisher is not None:
            publisher.close()
