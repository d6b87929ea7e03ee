"""Shared by the Zenoh sinks of one service: the session, and the complete map as one message."""

import atexit
import threading
from collections.abc import Callable
from typing import Protocol

import zenoh

from service.encoding import Message, encode_grid
from service.outputs import Grid
from service.publishing.config import PublishingConfig
from service.publishing.session import open_session


class GridSource(Protocol):
    """Source of the complete map."""

    def grid(self) -> Grid | None: ...


class MapPicture:
    """The complete map as a message, encoded once however many sinks send it. Thread-safe."""

    def __init__(self, source: GridSource) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._times_ns = (0, 0)
        self._made: tuple[tuple[int, int, int], Message] | None = None

    def changed(self, stamp_ns: int, log_ns: int) -> None:
        """Note the times of the newest scan in the map; Unix time."""
        self._times_ns = (stamp_ns, log_ns)

    def message(self) -> tuple[Message, int] | None:
        """On channel "map", with its version; None while there is no map."""
        with self._lock:
            times_ns = self._times_ns  # before the map: its picture is then never older than its stamp
            grid = self._source.grid()
            if grid is None:
                return None
            made_of = (grid.version, *times_ns)
            if self._made is None or self._made[0] != made_of:
                self._made = made_of, encode_grid(grid, *times_ns)
            return self._made[1], grid.version


class SharedZenoh:
    """One Zenoh session a service: opened by the first sink that needs it, closed by the last.
    Thread-safe.
    """

    def __init__(self, opener: Callable[[PublishingConfig], zenoh.Session] = open_session) -> None:
        self._opener = opener
        self._lock = threading.Lock()  # of all below
        self._session: zenoh.Session | None = None
        self._users = 0
        self._picture: MapPicture | None = None

    def open(self, config: PublishingConfig) -> zenoh.Session:
        """Raises StorageError where it cannot listen, or what the opener raises."""
        with self._lock:
            if self._session is None:
                self._session = self._opener(config)
                # Who fails to close it: as the interpreter ends, a call from Zenoh's threads would abort it.
                atexit.register(self._session.close)
            self._users += 1
            return self._session

    def close(self) -> None:
        """Call it once for each `open`. Raises ZError where Zenoh does not close."""
        with self._lock:
            self._users -= 1
            if self._users or self._session is None:
                return
            session, self._session = self._session, None
        atexit.unregister(session.close)
        session.close()  # type: ignore[no-untyped-call]

    def map_picture(self, source: GridSource) -> MapPicture:
        """The same for all; `source` is that of the first."""
        with self._lock:
            if self._picture is None:
                self._picture = MapPicture(source)
            return self._picture
