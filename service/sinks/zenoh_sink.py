"""Messages, the map and commands on Zenoh, as a sink."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

from drivers.link import LinkHealth
from service.encoding import WARNING, Message, Status, decode_diagnostics
from service.outputs import TileUpdate, reason_value
from service.publishing.certificate import UNTIL, validity_of
from service.publishing.config import PublishingConfig
from service.publishing.shared import SharedZenoh
from service.publishing.zenoh_publisher import ZenohPublisher
from service.sinks.counted_row import counted_row
from service.sinks.sink import Sink, SinkContext

log = logging.getLogger(__name__)

KEYS = {"diagnostics": "health"}  # channels that have another name on Zenoh
SERVICE, MAPPING = "service", "mapping"  # components beside the sensors that have a token
NOT_AT_WORK = ("waiting", "stale")  # states of the mapping without fresh poses
NOT_SENT = frozenset({"events", "map"})  # the publisher makes the map itself, when someone listens


class ZenohSink(Sink):
    """Sends from the moment it is constructed; answers commands from `start` on.

    Raises StorageError where Zenoh cannot listen.
    """

    name = "zenoh"

    def __init__(self, config: PublishingConfig, context: SinkContext) -> None:
        self._context = context
        self._validity = validity_of(config.secured)
        if fault := self._validity.fault():
            log.warning("zenoh: %s", fault)
        self._publisher = ZenohPublisher(
            config, context.vehicle, context.tiles, context.pose_sent, shared=context.shared.of(SharedZenoh)
        )

    def start(self) -> None:
        self._publisher.answer_commands(self._context.command)

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        channel = message.channel
        if channel in NOT_SENT or channel.endswith("/raw"):
            return
        if channel in KEYS:
            message = replace(message, channel=KEYS[channel])
            self._publisher.show_alive(alive_components(message, self._context.links))
        self._publisher.put(message, arrived_ns)

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        self._publisher.map_changed(tiles, stamp_ns, log_ns)

    def health(self) -> Status:
        endpoints = " ".join(self._publisher.endpoints)
        more = {"initialpose_refused": self._publisher.pose_refused, "endpoints": endpoints}
        more[UNTIL] = self._validity.until
        row = counted_row(self.name, self._publisher.counts(), more)
        if fault := self._validity.fault():
            return Status(self.name, WARNING, fault, {**row.values, **reason_value("certificate_not_valid")})
        return row

    def place(self) -> str:
        return ", ".join(self._publisher.endpoints)

    def close(self) -> None:
        self._publisher.close()


def alive_components(diagnostics: Message, links: Mapping[str, LinkHealth]) -> dict[str, bool]:
    """What has a token alive/<component>, and whether it does its work."""
    streaming = {name: link.state == "streaming" for name, link in links.items()}
    return {SERVICE: True, MAPPING: _is_mapping(diagnostics), **streaming}


def _is_mapping(diagnostics: Message) -> bool:
    """Whether poses come, be they good or bad; a pause is no failure."""
    rows = {row.name: row.values for row in decode_diagnostics(diagnostics.payload)}
    return rows.get(MAPPING, {}).get("state", "waiting") not in NOT_AT_WORK
