"""Limits of the port: so many connections at once, none of which may stay without a request.

Every connection is a file that the process may open less: recordings and devices need some, too.
"""

import asyncio
import ipaddress
import logging
import ssl
from collections import Counter
from collections.abc import Callable, Collection
from typing import Protocol, TypeVar

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

CONNECTIONS_A_BROWSER = 4  # one is its websocket; more to fetch the page faster
MIN_CONNECTIONS = 32
IDLE_S = 15.0  # without a complete request; a websocket is one that lasts
HANDSHAKE_S = 10.0  # of TLS
AT_ONCE = 16  # connections that asyncio accepts before any of them counts: so many may be too many

log = logging.getLogger(__name__)
SHARE_RESERVED = 4  # a quarter of the places
SHARE_OF_ADDRESS = 3  # of the rest, a third for one address


class _Refused(asyncio.Protocol):
    """A connection too many."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.abort()


class Listener:
    """Where there is no room, a new connection takes the place of the oldest that is no websocket.

    refused(): called for each connection too many, and for each request that breaks HTTP."""

    def __init__(self, most_browsers: int, refused: Callable[[], None]) -> None:
        self._most = max(MIN_CONNECTIONS, CONNECTIONS_A_BROWSER * most_browsers)
        self._refused = refused
        self.lasting: set[object] = set()  # protocols of the connections that are websockets
        self._log = logging.Logger(f"{__name__}.http")  # of this page alone: it counts for its health
        self._log.parent = log
        self._log.addFilter(self._is_ours)

    def runner(self, app: web.Application) -> web.AppRunner:
        return web.AppRunner(
            app,
            access_log=None,
            handle_signals=False,
            shutdown_timeout=1.0,
            keepalive_timeout=IDLE_S,
            auto_decompress=False,  # no request has a body that is read
            logger=self._log,
        )

    async def open(
        self, runner: web.AppRunner, host: str, port: int, tls: ssl.SSLContext | None
    ) -> asyncio.Server:
        """Listen. Raises OSError."""
        server = runner.server
        assert server is not None

        def connect() -> asyncio.BaseProtocol:
            if len(server.connections) < self._most:
                return server()
            self._refused()
            for oldest in server.connections:
                transport = oldest.transport
                if oldest not in self.lasting and transport is not None and not transport.is_closing():
                    transport.abort()
                    return server()
            return _Refused()

        timeout_s = HANDSHAKE_S if tls is not None else None
        return await asyncio.get_running_loop().create_server(
            connect, host, port, ssl=tls, backlog=AT_ONCE, reuse_address=True, ssl_handshake_timeout=timeout_s
        )

    def _is_ours(self, record: logging.LogRecord) -> bool:
        """False for what someone has sent that is no HTTP: it is counted; it would fill the log."""
        if record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError):
            return True
        self._refused()
        return False


class Seated(Protocol):
    """A browser at the page."""

    @property
    def address(self) -> str: ...
    @property
    def is_guest(self) -> bool: ...  # it has shown no token
    @property
    def must_show(self) -> bool: ...  # a token, soon


SeatedT = TypeVar("SeatedT", bound=Seated)


class Seats:
    """most: places in all."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._for_guests = most - most // SHARE_RESERVED
        self._of_address = max(1, self._for_guests // SHARE_OF_ADDRESS)

    def must_show(self, seated: Collection[Seated], address: str) -> bool:
        """Whether a newcomer has a place for a moment only, unless it shows a token.

        Programs of this machine may be many behind a proxy: no limit for each.
        """
        staying = Counter(one.address for one in seated if one.is_guest and not one.must_show)
        return staying.total() >= self._for_guests or (
            staying[address] >= self._of_address and not _is_loopback(address)
        )

    def has_place(self, seated: Collection[Seated]) -> bool:
        return len(seated) < self._most

    def to_leave(self, seated: Collection[SeatedT]) -> SeatedT | None:
        """The browser that is closed for a new one: of guests, first those that must show a token, the oldest
        of the address that has most. None where all have shown one. `seated`: the oldest first.
        """
        guests = [one for one in seated if one.is_guest]
        among = [one for one in guests if one.must_show] or guests
        crowd = Counter(one.address for one in among)
        return max(among, key=lambda one: crowd[one.address], default=None)


def _is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:
        return False
