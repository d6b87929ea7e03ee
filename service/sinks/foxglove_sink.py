"""Live pictures in Foxglove and Lichtblick, as a sink: what is recorded, over their websocket."""

import logging
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from service.encoding import CHANGES, ERROR, OK, Message, Status, encode_grid, schema_text
from service.errors import StorageError
from service.extras import install_command
from service.outputs import TileUpdate, reason_value
from service.sinks.foxglove_config import FoxgloveConfig
from service.sinks.sink import Sink, SinkContext
from service.web.config import split_listen

if TYPE_CHECKING:
    import foxglove

log = logging.getLogger(__name__)

MAX_WAITING = 2000  # messages, a few seconds of five devices; then the oldest goes
BACKLOG = 1024  # messages for one client that reads slowly; then its oldest goes
MAP_PERIOD_S = 1.0
RETRY_S = 5.0
MAP = "map"
KEPT = frozenset(("tf_static", "graph", CHANGES))  # the last one is for who comes late


def open_sink(config: FoxgloveConfig, context: SinkContext) -> "FoxgloveSink | None":
    """Raises StorageError where the package is not there that speaks the protocol."""
    if not config.enabled:
        return None
    try:
        import foxglove  # noqa: F401 - needed before the service starts
    except ImportError as error:
        raise StorageError(
            f"foxglove.enabled needs foxglove-sdk ({error}): {install_command('viewer')}; or set "
            "foxglove.enabled to false"
        ) from error
    return FoxgloveSink(config, context)


class FoxgloveSink(Sink):
    """Topics, types and bytes are those of a recording, so one layout shows both.

    A message goes out while someone subscribes to its topic. The complete map is made from the tiles, once a
    second while it changes and someone looks.
    """

    name = "foxglove"

    def __init__(self, config: FoxgloveConfig, context: SinkContext, retry_s: float = RETRY_S) -> None:
        self._listen = config.listen
        self._vehicle = context.vehicle
        self._tiles = context.tiles
        self._unix_ns = context.unix_ns
        self._retry_s = retry_s
        self._changed = threading.Condition()  # of what follows, down to _is_closing
        self._waiting: deque[Message] = deque()
        self._kept: dict[str, Message] = {}  # of KEPT
        self._requested: set[str] = set()  # channels that someone has just subscribed to
        self._map_stamp_ns = 0
        self._dropped = 0
        self._is_closing = False
        self._channels: dict[str, foxglove.Channel] = {}
        self._map_version = 0  # of the picture that was sent last
        self._map_due_s = 0.0
        self._sent = 0
        self._subscriptions = 0
        self._address, self._fault = "", "not started"
        self._thread = threading.Thread(target=self._run, name="foxglove-send", daemon=True)
        self._thread.start()

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        if message.channel == MAP or message.channel.endswith("/raw"):
            return
        with self._changed:
            if message.channel in KEPT:
                self._kept[message.channel] = message
            opened = self._channels.get(message.channel)
            if opened is not None and not opened.has_sinks():
                return
            if len(self._waiting) >= MAX_WAITING:
                self._waiting.popleft()
                self._dropped += 1
            self._waiting.append(message)
            self._changed.notify()

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        self._map_stamp_ns = stamp_ns

    def health(self) -> Status:
        values = {
            "address": self._address,
            "subscriptions": str(self._subscriptions),
            "sent": str(self._sent),
            "dropped": str(self._dropped),
        }
        if fault := self._fault:
            return Status(self.name, ERROR, fault, values | reason_value("not_served"))
        return Status(self.name, OK, "ok", values)

    def place(self) -> str:
        return self._address

    def close(self) -> None:
        with self._changed:
            self._is_closing = True
            self._changed.notify()
        self._thread.join()

    # What the SDK calls from threads of its own, see foxglove.websocket.ServerListener.

    def on_subscribe(self, client: Any, channel: Any) -> None:
        with self._changed:
            self._subscriptions += 1
            self._requested.add(channel.topic.removeprefix("/"))
            self._changed.notify()

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        with self._changed:
            self._subscriptions -= 1

    def _run(self) -> None:
        import foxglove

        context = foxglove.Context()
        server = self._open(context)
        if server is None:
            return
        with self._changed:
            self._requested.update(self._kept)  # they came before there was anybody to tell
        try:
            while True:
                with self._changed:
                    if not (self._waiting or self._requested or self._is_closing):
                        self._changed.wait(MAP_PERIOD_S)
                    messages, self._waiting = self._waiting, deque()
                    requested, self._requested = self._requested, set()
                    messages.extend(self._kept[channel] for channel in requested & self._kept.keys())
                    is_closing = self._is_closing
                for message in messages:
                    self._send(context, message)
                self._send_map(context, MAP in requested)
                if is_closing:
                    return
        finally:
            self._address = ""
            server.stop()

    def _open(self, context: "foxglove.Context") -> "foxglove.websocket.WebSocketServer | None":
        """None where the sink is closed before the port could be had."""
        import foxglove

        host, port = split_listen(self._listen)
        while True:
            try:
                server = foxglove.start_server(
                    name=self._vehicle,
                    host=host,
                    port=port,
                    capabilities=[],
                    server_listener=self,  # type: ignore[arg-type]
                    context=context,
                    message_backlog_size=BACKLOG,
                )
            except RuntimeError as error:
                words = f"Foxglove cannot be served at {self._listen}: {error}"
                if words != self._fault:
                    log.error("%s; tried again each %.0f s, mapping goes on", words, self._retry_s)
                self._fault = words
            else:
                shown = f"[{host}]" if ":" in host else host
                self._address, self._fault = f"ws://{shown}:{server.port}", ""
                return server
            with self._changed:
                self._changed.wait_for(lambda: self._is_closing, self._retry_s)
                if self._is_closing:
                    return None
                self._waiting.clear()  # no one can want them

    def _send(self, context: "foxglove.Context", message: Message) -> None:
        opened = self._channels.get(message.channel)
        if opened is None:
            opened = self._open_channel(context, message)
        opened.log(message.payload, log_time=message.log_ns)
        self._sent += 1

    def _open_channel(self, context: "foxglove.Context", message: Message) -> "foxglove.Channel":
        import foxglove

        schema = foxglove.Schema(
            name=message.type, encoding="ros2msg", data=schema_text(message.type).encode()
        )
        opened = foxglove.Channel(
            f"/{message.channel}", schema=schema, message_encoding="cdr", context=context
        )
        with self._changed:
            self._channels[message.channel] = opened
        return opened

    def _send_map(self, context: "foxglove.Context", is_requested: bool) -> None:
        """The complete map where someone subscribes and it has changed, or someone has just come."""
        version, now_s = self._tiles.version, time.monotonic()
        opened = self._channels.get(MAP)
        if version == 0 or (opened is not None and not opened.has_sinks()):
            return
        if not is_requested and (version == self._map_version or now_s < self._map_due_s):
            return
        self._map_due_s = now_s + MAP_PERIOD_S
        try:
            grid = self._tiles.grid()
        except StorageError as error:  # larger than one picture can be; reported once
            if self._map_version == 0:
                log.warning("foxglove: %s", error)
            self._map_version = version
            return
        if grid is not None:
            self._map_version = version
            self._send(context, encode_grid(grid, self._map_stamp_ns, self._unix_ns()))
