"""Publishes messages and the map on Zenoh. The mapper and the drivers never wait for it.

Poses are sent by the thread that puts them. Two threads send the rest: one the stream (scans, samples), 10 ms
late at most, one the bulk (tiles, the complete map, states). A late subscriber queries tiles, map, map/meta,
pose, tf_static and health are answered by get.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Protocol

import zenoh
import zenoh.ext

from drivers.rmw_zenoh import Attachment, make_gid
from drivers.zenoh_callback import daemon_callback
from service.encoding import CHANGES, TILES, Message, Status, encode_diagnostics, encode_tile, tile_channel
from service.outputs import TileUpdate
from service.publishing.command_queryable import CommandQueryable
from service.publishing.commands import Answer
from service.publishing.config import PublishingConfig
from service.publishing.initial_pose import CHANNEL as INITIAL_POSE
from service.publishing.initial_pose import InitialPoseSubscriber
from service.publishing.keys import alive_key, vehicle_key
from service.publishing.listeners import Listeners
from service.publishing.send_queues import Bulk, Sending
from service.publishing.senders import Senders
from service.publishing.session import listened_at
from service.publishing.shared import GridSource, SharedZenoh

TILE_PERIOD_S = 0.2  # a tile is sent at most so often: the newest counts, not each step in between
PICTURE_PERIOD_S = 1.0
MAX_VERSION_DIGITS = 19  # of a version, which has 63 bits in an attachment

POSES = ("pose", "odom", "tf")  # sent by who puts them: a thread between would cost them its wake-up
STATES = ("tf_static", "health", "graph", CHANGES)  # newest counts; cached for late joiners
PICTURES = ("map", "map/meta")  # made here, on a subscription or a query
ANSWERED = ("pose", *STATES)  # the last one sent is the answer to a get
# Last part of the channels whose late messages are worthless: sent first, without batching.
_FRESH = frozenset(("scan", "imu", "odom", "pose", "tf", "fix"))


class MapSource(GridSource, Protocol):
    """The tile store as the publisher reads it."""

    def since(self, version: int) -> list[TileUpdate]: ...


class ZenohPublisher:
    """Publishes on the Zenoh session; open when constructed, closed by close().

    on_latency takes nanoseconds from a message's origin_ns to the moment after its put; pictures are the
    wholes that are made, name begins the names of the threads. With tiles_wait a busy link delays tiles, the
    newest of each place, instead of dropping them.
    Raises StorageError where it cannot listen.
    """

    def __init__(
        self,
        config: PublishingConfig,
        vehicle: str,
        map_source: MapSource,
        on_latency: Callable[[int], None] | None = None,
        picture_period_s: float = PICTURE_PERIOD_S,
        shared: SharedZenoh | None = None,
        tile_period_s: float = TILE_PERIOD_S,
        pictures: Sequence[str] = PICTURES,
        name: str = "zenoh",
        tiles_wait: bool = False,
    ) -> None:
        self._vehicle = vehicle
        self._pictures = pictures
        self._tiles_wait = tiles_wait
        self._map = map_source
        self._on_latency = on_latency
        self._map_stamp_ns = self._map_log_ns = 0
        self._senders = Senders(name, tile_period_s, picture_period_s)
        self._token_lock = threading.Lock()
        self._sequences: Counter[str] = Counter()  # of the newest message, by channel
        self._publishers: dict[str, zenoh.Publisher | zenoh.ext.AdvancedPublisher] = {}
        self._gids: dict[str, bytes] = {}
        self._last: dict[str, tuple[Message, int]] = {}  # with its sequence number
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._alive: Mapping[str, bool] = {}  # as it is to be shown
        self._initial_pose: InitialPoseSubscriber | None = None
        shared = SharedZenoh() if shared is None else shared
        self._map_picture = shared.map_picture(map_source)
        self._session = shared.open(config)
        self._senders.opened.callback(shared.close)
        try:
            self.endpoints = listened_at(self._session, config)
            self._declare_queryables()
            self._senders.opened.callback(self._take_down_tokens)
            self._listeners = {
                channel: Listeners(
                    self._session, vehicle_key(vehicle, channel), partial(self._senders.bulk.ask_for, channel)
                )
                for channel in pictures
            }
        except BaseException:
            self._senders.close()
            raise
        self._senders.start(self._send_now, self._send_bulk)

    def __enter__(self) -> "ZenohPublisher":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def put(self, message: Message, origin_ns: int | None = None) -> None:
        """Send a pose, hand over any other message. A full queue drops its oldest, counted.

        Never waits, but for 1 ms at most with a pose while a subscriber does not read: then Zenoh drops it.
        """
        if message.channel in POSES and not self._senders.closed:
            self._send_now(Sending(message, origin_ns))
        elif message.channel in STATES:
            self._senders.bulk.put(message)
        else:
            self._senders.stream.put(Sending(message, origin_ns))

    def map_changed(self, tiles: Iterable[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        """Hand over tiles that the map source holds already; never waits. Times are Unix time.

        The source first: a client that subscribes and then queries must not miss a message between the two.
        """
        self._map_stamp_ns, self._map_log_ns = stamp_ns, log_ns
        self._map_picture.changed(stamp_ns, log_ns)
        self._senders.bulk.put_tiles(tiles)
        self._senders.bulk.ask_for(*self._pictures)

    def set_alive(self, component: str, alive: bool = True) -> None:
        """Put up or take down the token alive/<component>; all fall by themselves when the process dies."""
        with self._token_lock:
            if alive and component not in self._tokens and not self._senders.closed:
                key = alive_key(self._vehicle, component)
                self._tokens[component] = self._session.liveliness().declare_token(key)
            elif not alive and component in self._tokens:
                self._tokens.pop(component).undeclare()  # type: ignore[no-untyped-call]

    def show_alive(self, components: Mapping[str, bool]) -> None:
        """Have `set_alive` called for each with the next bulk, by the thread that sends it; never waits."""
        self._alive = components

    def answer_commands(self, answer: Callable[[str, bytes], Answer]) -> None:
        """Answer cmd/<verb>, and take poses on initialpose, from now on.

        `answer` takes verb and payload and may wait, in bounded time.
        """
        commands = CommandQueryable(self._session, self._vehicle, answer)
        self._senders.opened.callback(commands.close)
        self._initial_pose = InitialPoseSubscriber(
            self._session, vehicle_key(self._vehicle, INITIAL_POSE), answer
        )
        self._senders.opened.callback(self._initial_pose.close)

    @property
    def pose_refused(self) -> str:
        """Why the newest pose on initialpose was not taken, "" if it was."""
        return self._initial_pose.refused if self._initial_pose is not None else ""

    def counts(self) -> dict[str, Counter[str]]:
        """Messages sent, dropped and failed (answers too), by channel; tiles under map/tile."""
        return self._senders.counts()

    def close(self) -> None:
        """Send what waits, then take everything down. A second call does nothing."""
        self._senders.close()

    def _take_down_tokens(self) -> None:
        for component in list(self._tokens):
            self.set_alive(component, False)

    def _send_now(self, sending: Sending) -> None:
        self._senders.attempt(sending.message.channel, partial(self._send, sending.message))
        if sending.origin_ns is not None and self._on_latency is not None:
            self._on_latency(time.monotonic_ns() - sending.origin_ns)

    def _send_bulk(self, bulk: Bulk) -> None:
        for message in bulk.messages:
            self._senders.attempt(message.channel, partial(self._send, message))
        for component, alive in self._alive.items():
            self._senders.attempt("alive", partial(self.set_alive, component, alive))
        for tile in bulk.tiles:
            self._senders.attempt(TILES, partial(self._send_tile, tile))
        for channel in bulk.pictures:
            self._senders.attempt(channel, partial(self._send_picture, channel))

    def _send(self, message: Message, sequence: int | None = None) -> None:
        channel = message.channel
        publisher = self._publishers.get(channel)
        if publisher is None:
            publisher = self._publishers[channel] = self._declare(channel, message.type)
        if sequence is None:
            sequence = self._sequences[channel] = self._sequences[channel] + 1
        publisher.put(message.payload, attachment=self._attachment(channel, sequence, message.log_ns))
        self._senders.count(channel)
        if channel in ANSWERED:
            self._last[channel] = (message, sequence)

    def _send_tile(self, tile: TileUpdate) -> None:
        message = encode_tile(tile, self._map_stamp_ns, self._map_log_ns)
        congestion = zenoh.CongestionControl
        self._session.put(
            vehicle_key(self._vehicle, message.channel),
            message.payload,
            encoding=_encoding(message.type),
            congestion_control=congestion.BLOCK if self._tiles_wait else congestion.DROP,
            priority=zenoh.Priority.DATA_LOW,
            attachment=self._attachment(TILES, tile.version, message.log_ns),
        )
        self._senders.count(TILES)

    def _send_picture(self, channel: str) -> None:
        if self._listeners[channel].are_there and (picture := self._make_picture(channel)) is not None:
            self._send(*picture)

    def _make_picture(self, channel: str) -> tuple[Message, int] | None:
        """The complete map, or its index, with its version; None while there is no map."""
        return self._make_meta() if channel == "map/meta" else self._map_picture.message()

    def _make_meta(self) -> tuple[Message, int] | None:
        tiles = self._map.since(0)
        if not tiles:
            return None
        newest = tiles[-1]
        about = {
            "version": str(newest.version),
            "tiles": str(len(tiles)),
            "cell_m": f"{newest.cell_m:g}",
            "tile_cells": str(newest.cells.shape[0]),
            "gid": self._gid(TILES).hex(),
        }
        index = {f"{t.level}/{t.ix}/{t.iy}": str(t.version) for t in tiles}
        statuses = [Status("map", 0, f"version {newest.version}", about), Status("tiles", 0, "", index)]
        message = encode_diagnostics("map/meta", statuses, self._map_stamp_ns, self._map_log_ns)
        return message, newest.version

    def _declare(self, channel: str, message_type: str) -> zenoh.Publisher | zenoh.ext.AdvancedPublisher:
        key = vehicle_key(self._vehicle, channel)
        if channel in STATES or channel in PICTURES:
            return zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                encoding=_encoding(message_type),
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW if channel == "map" else zenoh.Priority.DATA,
                cache=zenoh.ext.CacheConfig(max_samples=1),
                publisher_detection=True,
            )
        fresh = channel.rpartition("/")[2] in _FRESH
        return self._session.declare_publisher(
            key,
            encoding=_encoding(message_type),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH if fresh else zenoh.Priority.DATA,
            express=fresh,
        )

    def _declare_queryables(self) -> None:
        answers: dict[str, Callable[[zenoh.Query], None]] = {f"{TILES}/**": self._answer_tiles}
        answers |= {channel: partial(self._answer_picture, channel) for channel in self._pictures}
        answers |= {channel: partial(self._answer_last, channel) for channel in ANSWERED}
        for channel, answer in answers.items():
            taken = daemon_callback(partial(self._answer, channel, answer), f"zenoh-answer-{channel}")
            queryable = self._session.declare_queryable(
                vehicle_key(self._vehicle, channel), taken, complete=True
            )
            self._senders.opened.callback(queryable.undeclare)

    def _answer(self, channel: str, answer: Callable[[zenoh.Query], None], query: zenoh.Query) -> None:
        with query:  # without it the asker would wait until its timeout
            if not self._senders.attempt(channel, partial(answer, query)):
                query.reply_err(f"{channel} cannot be answered now; the service's log says why".encode())

    def _answer_tiles(self, query: zenoh.Query) -> None:
        since = query.parameters.get("since", "0") or ""
        if not (since.isascii() and since.isdigit() and len(since) <= MAX_VERSION_DIGITS):
            shown = since[:MAX_VERSION_DIGITS]
            query.reply_err(f'since={shown}: expected a version, as in "map/tile/**?since=0"'.encode())
            return
        for tile in self._map.since(int(since)):
            key = vehicle_key(self._vehicle, tile_channel(tile))
            if query.key_expr.intersects(zenoh.KeyExpr(key)):
                message = encode_tile(tile, self._map_stamp_ns, self._map_log_ns)
                self._reply(query, message, self._attachment(TILES, tile.version, message.log_ns))

    def _answer_picture(self, channel: str, query: zenoh.Query) -> None:
        if (picture := self._make_picture(channel)) is not None:
            message, version = picture
            self._reply(query, message, self._attachment(channel, version, message.log_ns))

    def _answer_last(self, channel: str, query: zenoh.Query) -> None:
        if (last := self._last.get(channel)) is not None:
            message, sequence = last
            self._reply(query, message, self._attachment(channel, sequence, message.log_ns))

    def _reply(self, query: zenoh.Query, message: Message, attachment: bytes) -> None:
        key = vehicle_key(self._vehicle, message.channel)
        query.reply(key, message.payload, encoding=_encoding(message.type), attachment=attachment)

    def _attachment(self, channel: str, sequence: int, source_ns: int) -> bytes:
        return Attachment(sequence, source_ns, self._gid(channel)).encode()

    def _gid(self, channel: str) -> bytes:
        gid = self._gids.get(channel)
        if gid is None:
            gid = self._gids[channel] = make_gid(str(self._session.zid()), channel)
        return gid


def _encoding(message_type: str) -> zenoh.Encoding:
    return zenoh.Encoding.APPLICATION_CDR.with_schema(message_type)
