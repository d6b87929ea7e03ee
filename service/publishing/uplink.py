"""The session of a vehicle at a router of its site: limits of the link, and counts."""

import socket
import struct
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import zenoh

from drivers.zenoh_config import zenoh_config
from service.errors import StorageError
from service.publishing.certificate import refused, validity_of
from service.publishing.config import PublishingConfig, tcp_address
from service.publishing.keys import ROOT, alive_key
from service.publishing.security import link_settings
from service.publishing.session import own_internet_sockets

CONNECT_MS = 3000  # for one try
RETRY_MS = (500, 30_000)  # first and longest pause between two tries: a site's router begins with all at once
HEALTH_JITTER_S = 0.3  # it comes each second, a little early or late: that is no message too many
_BYTES_ACKED_AT = 120  # of struct tcp_info in linux/tcp.h: bytes_acked, bytes_received


def open_client(config: PublishingConfig, further: Mapping[str, object] = {}) -> zenoh.Session:
    """Connected to one of the routers in `config.connect`; a lost link comes back by itself.

    further   settings of Zenoh, by path

    Raises StorageError where none answers in time, or as link_settings.
    """
    settings = {
        "mode": "client",
        "connect/endpoints": config.connect,
        "connect/timeout_ms": CONNECT_MS,
        "connect/retry": {
            "period_init_ms": RETRY_MS[0],
            "period_max_ms": RETRY_MS[1],
            "period_increase_factor": 2,
        },
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/unicast/compression/enabled": True,  # tiles to a tenth, where the router does so, too
        **(link_settings(config.secured) if config.secured is not None else {}),
        **further,
    }
    try:
        return zenoh.open(zenoh_config(settings))
    except zenoh.ZError as error:
        reason = str(error).partition(" at /")[0]
        is_tls = any(one.startswith("tls/") for one in config.connect)
        both = ", and are the certificates of both valid and of one authority" if is_tls else ""
        hint = validity_of(config.secured).fault() or _refused(config) or f"is it running{both}?"
        raise StorageError(f"no router at {', '.join(config.connect)}: {hint} ({reason})") from error


def _refused(config: PublishingConfig) -> str:
    """Whose certificate is not accepted here, of the routers in `connect`: Zenoh reports a time-out."""
    if config.secured is None or (tls := config.secured.tls) is None:
        return ""
    for endpoint in config.connect:
        address = tcp_address(endpoint) if endpoint.startswith("tls/") else None
        if address is not None and (why := refused(address, tls)):
            return (
                f"it answers, and {tls.ca} does not accept its certificate: {why}; corridor security init "
                "makes one for the host in connect, by the same authority"
            )
    return ""


def open_uplink(config: PublishingConfig) -> zenoh.Session:
    """Session of a vehicle; Zenoh limits it to the rates of `config.fleet`. Raises as open_client."""
    health_s = 1.0 / config.fleet.health_hz - HEALTH_JITTER_S
    limits_hz = {"pose": config.fleet.pose_hz, "health": 1.0 / health_s}
    rules = [{"key_expr": f"{ROOT}/*/{channel}", "freq": hz} for channel, hz in limits_hz.items()]
    return open_client(
        config,
        {
            "downsampling": [{"id": "fleet", "flows": ["egress"], "messages": ["put"], "rules": rules}],
            # A pose that finds the link busy is dropped at once: the mapper puts it.
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
        },
    )


@dataclass(frozen=True, slots=True, order=True)
class Presence:
    """A session by the name of a vehicle: by its liveliness token. The first is the earliest."""

    began_ns: int  # Unix time by its own clock, or later than those that were there when it came
    session: str  # Zenoh's identifier
    host: str
    address: str  # by which it reaches the router

    def key(self, vehicle: str) -> str:
        parts = str(self.began_ns), self.session, self.host, self.address
        return alive_key(vehicle, "/".join(("fleet", *parts)))

    def __str__(self) -> str:
        return f"{self.host} at {self.address} (session {self.session[:8]})"


PRESENCES = alive_key("*", "fleet/*/*/*/*")


def read_presence(key: str) -> tuple[str, Presence] | None:
    """Vehicle, and who it is; None of another key."""
    parts = key.removeprefix(f"{ROOT}/").split("/")
    if len(parts) != 7 or parts[1:3] != ["alive", "fleet"] or not (parts[3].isascii() and parts[3].isdigit()):
        return None
    return parts[0], Presence(int(parts[3]), *parts[4:])


def presences(keys: Iterable[str]) -> dict[str, list[Presence]]:
    """Sessions by vehicle, the earliest first. Two sessions: two vehicles have one name."""
    found: dict[str, list[Presence]] = {}
    for vehicle, presence in filter(None, map(read_presence, keys)):
        found.setdefault(vehicle, []).append(presence)
    return {vehicle: sorted(found[vehicle]) for vehicle in sorted(found)}


class LinkBytes:
    """Bytes to and from the router since the first look, over all links of a session, as the kernel counts
    them: with TLS, framing and what Zenoh itself sends. Not of udp.
    """

    def __init__(self) -> None:
        self.sent = self.received = 0
        self.links = 0  # that there were
        self._source, self._last = "", (0, 0)

    def look(self, source: str) -> None:
        """source: the present link's end here, "tcp/10.0.0.7:40212"; "" without a link."""
        if source and source != self._source:
            self.links += 1
            self._source, self._last = source, (0, 0)
        if source and (counts := _acked_and_received(source.rpartition(":")[2])) is not None:
            self.sent += counts[0] - self._last[0]
            self.received += counts[1] - self._last[1]
            self._last = counts


def _acked_and_received(port: str) -> tuple[int, int] | None:
    """Bytes of this process's connection from that port; None where the kernel does not report them."""
    for link in own_internet_sockets():
        with suppress(OSError, struct.error):  # closed meanwhile, or not connected
            if str(link.getsockname()[1]) != port or link.getpeername()[1] == int(port):
                continue
            info = link.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
            acked, received = struct.unpack_from("QQ", info, _BYTES_ACKED_AT)
            return int(acked), int(received)
    return None
