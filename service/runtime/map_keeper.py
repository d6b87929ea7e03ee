"""The map on its way to the disk: into the recording every few seconds, into the map store now and then.

It reads the TileStore from a thread of its own: neither a slow disk nor a large picture holds up mapping.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.encoding import Message, encode_grid
from service.errors import StorageError
from service.geometry.geo_reference import GeoReference
from service.mapstore.files import save_map
from service.mapstore.tiles import NumberedMap, TileStore
from service.runtime.host_time import HostTime

log = logging.getLogger(__name__)

RECORD_INTERVAL_S = 10.0  # a whole map a second would outgrow the scans
MOST_UNSAVED = 8  # maps that a reset ended and the disk has not taken yet


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map on disk."""

    folder: Path
    number: int  # of the version in its folder
    version: int  # of its newest tile
    geo: GeoReference | None = None  # where it lies on the earth


Saved = Callable[[SavedMap | None, str], None]  # the present map, None while it is empty; or what went wrong


class MapKeeper:
    """Keeps the map safe while it grows. `run` is its thread's work; `finish` ends it in another.

    folder    where the first map goes; those after a reset go beside it, to <folder>_2, <folder>_3 ...
    """

    def __init__(
        self,
        folder: Path,
        tiles: TileStore,
        host_time: HostTime,
        checkpoint_s: float,
        about: Mapping[str, str],
        record: Callable[[Message], Any],
    ) -> None:
        self._folder = folder
        self._tiles = tiles
        self._host_time = host_time
        self._checkpoint_s = checkpoint_s
        self._about = about
        self._record = record
        self._recorded_version = 0
        self._unsaved: list[NumberedMap] = []  # ended by a reset
        self._wake = threading.Condition()
        self._asked: deque[Saved] = deque()
        self._stopping = False
        self._newest: tuple[int, SavedMap] | None = None  # map number
        self.trouble = ""  # why the last save failed, "" if it did not

    @property
    def folder(self) -> Path:
        """Of the present map."""
        return self.folder_of(self._tiles.number)

    @property
    def newest(self) -> SavedMap | None:
        """What was saved last; after a reset the map before, until there is something to save."""
        return None if self._newest is None else self._newest[1]

    @property
    def saved_version(self) -> int:
        """Newest tile of the present map that is on disk; 0: none."""
        newest = self._newest
        return newest[1].version if newest is not None and newest[0] == self._tiles.number else 0

    def folder_of(self, number: int) -> Path:
        return self._folder if number == 1 else self._folder.with_name(f"{self._folder.name}_{number}")

    def ask_to_save(self, saved: Saved) -> None:
        """Have what is not yet on disk saved soon, by the thread of `run`, in which `saved` hears of it."""
        with self._wake:
            self._asked.append(saved)
            self._wake.notify()

    def stop(self) -> None:
        """Let `run` return."""
        with self._wake:
            self._stopping = True
            self._wake.notify()

    def run(self) -> None:
        save_at_s = time.monotonic() + self._checkpoint_s
        while self._wait():
            self._answer()
            self.record()
            if time.monotonic() >= save_at_s:
                save_at_s = time.monotonic() + self._checkpoint_s
                self._try_to_save()

    def finish(self) -> None:
        """Record and save what is not yet; call it when the map no longer changes. Raises StorageError."""
        self._answer()
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

    def save(self) -> SavedMap | None:
        """Store what is not yet: maps that a reset ended, then the present one, which is returned.

        Raises StorageError; what could not be saved is tried again the next time.
        """
        ended, present = self._tiles.take()
        self._unsaved += ended
        while len(self._unsaved) > MOST_UNSAVED:
            lost = self._unsaved.pop(0)
            log.error("map %d is given up: the disk took none of %d", lost.number, MOST_UNSAVED)
        while self._unsaved:
            self._store(self._unsaved[0])
            self._unsaved.pop(0)
        self._store(present)
        self.trouble = ""
        return self._newest[1] if self._newest is not None and self._newest[0] == present.number else None

    def _store(self, numbered: NumberedMap) -> None:
        newest = self._newest
        if (
            newest is not None
            and newest[0] == numbered.number
            and newest[1].version == numbered.version
            and newest[1].geo == numbered.geo
        ):
            return
        folder = self.folder_of(numbered.number)
        unix_ns = self._host_time.unix_ns(time.monotonic_ns())
        number = save_map(folder, numbered.tiles, unix_ns, self._about, numbered.geo)
        if number is not None:
            self._newest = (numbered.number, SavedMap(folder, number, numbered.version, numbered.geo))

    def _wait(self) -> bool:
        """Until somebody asks or it is time to look; False when there is nothing more to do."""
        with self._wake:
            if not self._asked and not self._stopping:
                self._wake.wait(min(RECORD_INTERVAL_S, self._checkpoint_s))
            return not self._stopping

    def _answer(self) -> None:
        with self._wake:
            asked, self._asked = self._asked, deque()
        if not asked:
            return
        saved = self._try_to_save()
        for answer in asked:
            answer(saved, self.trouble)

    def _try_to_save(self) -> SavedMap | None:
        try:
            return self.save()
        except StorageError as error:
            self._complain(error)
            return None

    def _complain(self, error: StorageError) -> None:
        if str(error) != self.trouble:  # once, not at every try
            log.error("%s", error)
        self.trouble = str(error)
