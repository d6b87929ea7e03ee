"""The map on its way to the disk: into the recording every few seconds, into the map store now and then.

It reads the TileStore from a thread of its own: neither a slow disk nor a large picture holds up mapping.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from service.encoding import Message, encode_grid
from service.errors import StorageError
from service.mapstore.files import save_map
from service.mapstore.tiles import TileStore
from service.runtime.host_time import HostTime

log = logging.getLogger(__name__)

RECORD_INTERVAL_S = 10.0  # a whole map a second would outgrow the scans


class MapKeeper:
    """Keeps the map safe while it grows. `run` is its thread's work; `finish` ends it in another."""

    def __init__(
        self,
        folder: Path,
        tiles: TileStore,
        host_time: HostTime,
        checkpoint_s: float,
        about: Mapping[str, str],
        record: Callable[[Message], Any],
    ) -> None:
        self.folder = folder
        self._tiles = tiles
        self._host_time = host_time
        self._checkpoint_s = checkpoint_s
        self._about = about
        self._record = record
        self._recorded_version = 0
        self.saved_version = 0  # newest tile that is on disk
        self.trouble = ""  # why the last save failed, "" if it did not

    def run(self, stop: threading.Event) -> None:
        save_at_s = time.monotonic() + self._checkpoint_s
        while not stop.wait(min(RECORD_INTERVAL_S, self._checkpoint_s)):
            self.record()
            if time.monotonic() >= save_at_s:
                save_at_s = time.monotonic() + self._checkpoint_s
                self._try_to_save()

    def finish(self) -> None:
        """Record and save what is not yet; call it when the map no longer changes. Raises StorageError."""
        self.record()
        self.save()

    def record(self) -> None:
        """Put the whole map into the recording if it changed."""
        version = self._tiles.version
        if version == self._recorded_version:
            return
        self._recorded_version = version
        try:
            grid = self._tiles.grid()
        except StorageError as error:
            self._complain(error)  # too large for one picture; the tiles are saved all the same
            return
        if grid is not None:
            unix_ns = self._host_time.unix_ns(time.monotonic_ns())
            self._record(encode_grid(grid, unix_ns, unix_ns))

    def save(self) -> None:
        """Store the map if it changed. Raises StorageError."""
        version = self._tiles.version
        if version > self.saved_version:
            unix_ns = self._host_time.unix_ns(time.monotonic_ns())
            save_map(self.folder, self._tiles.since(0), unix_ns, self._about)
            self.saved_version, self.trouble = version, ""

    def _try_to_save(self) -> None:
        try:
            self.save()
        except StorageError as error:
            self._complain(error)

    def _complain(self, error: StorageError) -> None:
        if str(error) != self.trouble:  # once, not at every try
            log.error("%s", error)
        self.trouble = str(error)
