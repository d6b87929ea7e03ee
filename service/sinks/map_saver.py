"""Saves the map, as a sink: to the recording every few seconds, to its folder now and then.

It reads the TileStore from a thread of its own: neither a slow disk nor a large picture holds up mapping.
"""

import logging
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from service.encoding import ERROR, OK, Message, Status, encode_grid
from service.errors import StorageError, words_of
from service.mapstore.config import MapConfig
from service.mapstore.files import keep_version, save_map
from service.mapstore.graph_files import remove_overtaken
from service.mapstore.in_use import InUse, MapsInUse
from service.mapstore.tiles import NumberedMap
from service.outputs import reason_value
from service.sinks.sink import SavedHeard, SavedMap, Sink, SinkContext
from service.writable import make_writable

log = logging.getLogger(__name__)

EMIT_INTERVAL_S = 10.0  # a complete map a second would outgrow the scans
GRAPH_S = 5.0  # that the graph may take to be put away when the map is requested
MAX_UNSAVED = 8  # maps that a reset ended and the disk has not taken yet
MAX_ASKED = 64
# A graph folder that has not changed for so long, while checkpoints come, is of a session that was killed.
ABANDONED_S = 3600.0


class _Requested(NamedTuple):
    saved: SavedHeard
    name: str
    with_graph: bool
    number: int  # of the map that was the present one then


class _GraphRequest(NamedTuple):
    then: Callable[[], None]


class _Profile(NamedTuple):
    name: str
    stores_graph: bool


class MapSaver(Sink):
    """Saves the map while it grows; a MapStorage, whose words hold here where a method has none.

    The first map goes to the folder that the context names, else to <vehicle>_<UTC start> in the directory of
    the config; those after a reset go beside it, to <folder>_2, <folder>_3 ... A session that begins in a
    stored map adds versions to it, and one that is only localised saves nothing.
    """

    name = "map"

    def __init__(self, config: MapConfig, context: SinkContext) -> None:
        started = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(context.start_unix_ns / 1e9))
        self._started = started
        self._again = config.directory / f"{context.vehicle}_{started}"
        self._folder = context.map_folder or config.load or self._again
        self.graph_folder = self._folder.with_name(f".{self._folder.name}.graph-{os.getpid()}")
        is_going_on = self._folder == config.load and not context.is_localizing
        self._goes_on_in = (self._folder, context.load_version) if is_going_on else None
        self._in_use = MapsInUse(f"a session of {context.vehicle}")
        self._begun_in: dict[int, Path] = {}  # numbers of maps of this run -> the stored one each began in
        self._is_kept_out = False  # the map to go on in is another's
        self._directory = config.directory
        self._present: NumberedMap | None = None  # as it was at the last save
        self._command = context.command
        self._is_localizing = context.is_localizing
        self._tiles = context.tiles
        self._unix_ns = context.unix_ns
        self._emit = context.emit
        self._checkpoint_s = config.checkpoint_s
        self._vehicle = context.vehicle
        self._made_by = {1: _Profile(context.profile, context.stores_graph)}  # from the map of that number on
        self._emitted_version = 0
        self._unsaved: list[NumberedMap] = []  # ended by a reset
        self._ended: dict[int, tuple[SavedMap | None, str]] = {}  # by number: where it is, or why nowhere
        self._wake = threading.Condition()  # of the two that follow
        self._requested: deque[_Requested | _GraphRequest] = deque()
        self._stopping = False
        self._newest: tuple[int, SavedMap] | None = None  # map number
        self._thread = threading.Thread(target=self._run, name="map-saver", daemon=True)
        self._delayed = ""  # why the present map is not stored yet, though nothing failed
        self._given_up = ""  # which map of this run is lost, and why
        self.fault = ""  # why the last save failed, "" if it did not

    @property
    def folder(self) -> Path:
        """Of the present map."""
        return self.folder_of(self._tiles.number)

    @property
    def newest(self) -> SavedMap | None:
        """What was saved last; after a reset the map before, until there is something to save."""
        return None if self._newest is None else self._newest[1]

    @property
    def stored_folder(self) -> Path | None:
        """Of the present map, where a version of it is on disk: that of its pose, too."""
        number = self._tiles.number
        begun_in = self._folder if self._is_localizing and number == 1 else self._begun_in.get(number)
        saved = self._newest_of(number)
        return begun_in if saved is None else saved.folder

    @property
    def saved_version(self) -> int:
        """Newest tile of the present map that is on disk; 0: none."""
        newest = self._newest_of(self._tiles.number)
        return 0 if newest is None else newest.version

    def folder_of(self, number: int) -> Path:
        new = self._folder if number == 1 else self._folder.with_name(f"{self._folder.name}_{number}")
        return self._begun_in.get(number, new)

    def hold(self, folder: Path, version: int | None) -> None:
        """Keep others from changing a stored map that is about to be begun in, and keep the version for
        replays of this session; None: it is not known. Raises StorageError.
        """
        if self._is_localizing:
            return
        self._in_use.hold(folder)
        if version is not None:
            keep_version(folder, version, f"a session of {self._vehicle} began in it, {self._started}")

    def let_go(self, folder: Path) -> None:
        self._in_use.let_go(folder)

    def begun_in(self, folder: Path) -> None:
        self._let_go_of(self._tiles.number)  # it has no tile
        self._begun_in[self._tiles.number] = folder

    def begun_new(self) -> None:
        """The present map is a new one, also where what was begun in had no tile yet when it was reset."""
        number = self._tiles.number
        if number == 1 and self._begun_in.get(number) == self._folder:
            self._folder = self._again
        self._let_go_of(number)
        self._begun_in.pop(number, None)

    def _let_go_of(self, number: int) -> None:
        if number in self._begun_in:
            self._in_use.let_go(self._begun_in[number])

    def mapped_by(self, profile: str, stores_graph: bool) -> None:
        self.begun_new()
        self._made_by[self._tiles.number] = _Profile(profile, stores_graph)

    def ask_to_save(self, saved: SavedHeard, name: str = "", with_graph: bool = False) -> None:
        """Have what is not yet on disk saved soon, by the sink's thread, in which `saved` hears of it.

        name   of a folder in the directory of the config: the present map becomes its next version, too
        with_graph   the graph is put away before, as it is now; within GRAPH_S, else as it was last

        A map that has ended before it is saved so is saved in its folder alone, and `saved` hears of that.
        Where MAX_ASKED wait already, it hears so at once, in the caller's thread.
        """
        if refused := self._take(_Requested(saved, name, with_graph, self._tiles.number)):
            saved(None, f"not saved: {refused}")

    def put_graph_away(self, then: Callable[[], None]) -> None:
        """Have the graph of the present map put away soon, as it is now, for the map to end. `then` is called
        in the sink's thread: when it is, or not within GRAPH_S. Raises StorageError where MAX_ASKED wait
        already; then it is never called.
        """
        if refused := self._take(_GraphRequest(then)):
            raise StorageError(refused)

    def _take(self, requested: _Requested | _GraphRequest) -> str:
        """Why it is not taken, "" if it is."""
        with self._wake:
            if len(self._requested) >= MAX_ASKED:
                return (
                    f"{MAX_ASKED} requests wait for the disk of {self.folder.parent}; look whether it is "
                    "full, slow or gone, and ask again"
                )
            self._requested.append(requested)
            self._wake.notify()
        return ""

    def start(self) -> None:
        """Raises StorageError where the map cannot be stored, where another session goes on in it or someone
        edits it.
        """
        if self._goes_on_in is not None:
            self._is_kept_out = True
            self.hold(*self._goes_on_in)
            self._is_kept_out = False
            self._begun_in[1] = self._goes_on_in[0]
        if not self._is_localizing:
            make_writable(self._folder.parent)
        self._thread.start()

    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        """The map is taken from the TileStore: messages pass."""
        return

    def health(self) -> Status:
        fault = self.fault or self._given_up
        values = {"folder": str(self.folder), "saved_version": str(self.saved_version)}
        if not fault:
            return Status(self.name, OK, "ok", values)
        return Status(self.name, ERROR, fault, values | reason_value("map_not_saved"))

    def place(self) -> str:
        return str(self.folder)

    def written(self) -> list[Path]:
        """The folder of the newest map that was saved; none where nothing was mapped."""
        return [] if self.newest is None else [self.newest.folder]

    def flush(self) -> None:
        """Emit and save what is not yet. Raises StorageError where a map of this run is not on disk.

        Where start() raised, nothing is saved.
        """
        self._stop()
        if self._thread.ident is not None:
            self._thread.join()
        self._answer()
        self._emit_map()
        try:
            self.save()
        except StorageError as error:
            self._report(error)
            raise
        finally:
            shutil.rmtree(self.graph_folder, ignore_errors=True)
            self._in_use.let_all_go()
        if why := self._given_up or self._delayed:
            raise StorageError(why)

    def close(self) -> None:
        self._stop()
        self._in_use.let_all_go()

    def save(self) -> SavedMap | None:
        """Store what is not yet: maps that a reset ended, then the present one, which is returned.

        Raises StorageError; what could not be saved is tried again the next time.
        """
        if self._is_localizing or self._is_kept_out:
            return None
        ended, present = self._tiles.take()
        self._unsaved += ended
        self._present = present
        self._remove_overtaken_graphs(present)
        while len(self._unsaved) > MAX_UNSAVED:
            lost = self._unsaved.pop(0)
            self._let_go_of(lost.number)
            self._given_up = (
                f"map {lost.number} of this run is not saved: more than {MAX_UNSAVED} ended maps wait to be "
                f"saved under {self._folder.parent}; make room there, or change map.directory"
            )
            self._ended[lost.number] = (None, self._given_up)
            log.error("%s", self._given_up)
        while self._unsaved:
            delayed = self._store(self._unsaved[0])
            number = self._unsaved.pop(0).number
            self._let_go_of(number)
            self._ended[number] = (self._newest_of(number), delayed)
        self._delayed = self._store(present)
        self.fault = ""
        return self._newest_of(present.number)

    def _newest_of(self, number: int) -> SavedMap | None:
        return self._newest[1] if self._newest is not None and self._newest[0] == number else None

    def _store(self, numbered: NumberedMap) -> str:
        """Why it is not stored, though nothing failed; "" where it is, or holds nothing new."""
        if numbered.tiles and self._would_lose_its_graph(numbered):
            folder = self.folder_of(numbered.number)
            delayed = (
                f"{folder} stays as it is, for the graph of what was mapped since is not put away; a replay "
                "of the recording with --map and --out maps it again"
            )
            log.warning("%s", delayed)
            return delayed
        newest = self._newest_of(numbered.number)
        if (
            newest is not None
            and newest.version == numbered.version
            and newest.geo == numbered.geo
            and newest.graph == numbered.graph
        ):
            return ""
        folder = self.folder_of(numbered.number)
        about = self._about(numbered.number)
        number = save_map(folder, numbered.tiles, self._unix_ns(), about, numbered.geo, numbered.graph)
        if number is not None:
            saved = SavedMap(folder, number, numbered.version, numbered.geo, numbered.graph)
            self._newest = (numbered.number, saved)
        return ""

    def _would_lose_its_graph(self, numbered: NumberedMap) -> bool:
        """Whether no one could go on in the stored map any more that this one began in."""
        is_begun_in = numbered.number in self._begun_in
        return is_begun_in and numbered.graph is None and self._profile_of(numbered.number).stores_graph

    def _remove_overtaken_graphs(self, present: NumberedMap) -> None:
        if present.graph is None or self.graph_folder not in present.graph.parents:
            return
        try:
            remove_overtaken(present.graph)
        except OSError as error:
            log.warning("graphs of this session that are not needed any more cannot be removed: %s", error)

    def _run(self) -> None:
        if self._requests_graph:
            self._remove_abandoned_graphs()
        ask_at_s = time.monotonic() + 0.5 * self._checkpoint_s
        save_at_s = ask_at_s + 0.5 * self._checkpoint_s
        while self._wait():
            self._answer()
            self._emit_map()
            if self._requests_graph and time.monotonic() >= ask_at_s:
                ask_at_s = time.monotonic() + self._checkpoint_s
                self._command("checkpoint", b"{}")  # the graph comes to the TileStore when it is written
            if time.monotonic() >= save_at_s:
                save_at_s = time.monotonic() + self._checkpoint_s
                self.try_to_save()

    @property
    def _requests_graph(self) -> bool:
        return self._profile_of(self._tiles.number).stores_graph and not self._is_localizing

    def _profile_of(self, number: int) -> _Profile:
        made_by = dict(self._made_by)  # in one step: another thread may add to it
        return made_by[max(first for first in made_by if first <= number)]

    def _about(self, number: int) -> Mapping[str, str]:
        return {"vehicle": self._vehicle, "profile": self._profile_of(number).name}

    def _remove_abandoned_graphs(self) -> None:
        """A session that is killed leaves its graph folder behind; its map holds what it needs of it."""
        try:
            for folder in self.graph_folder.parent.glob(".*.graph-*"):
                age_s = time.time() - folder.stat().st_mtime
                if folder != self.graph_folder and age_s >= ABANDONED_S and not _is_alive(folder):
                    shutil.rmtree(folder)
                    log.info("removed %s, left by a session that was killed", folder)
        except OSError as error:
            log.warning("what sessions that were killed have left cannot be removed: %s", error)

    def _stop(self) -> None:
        with self._wake:
            self._stopping = True
            self._wake.notify()

    def _emit_map(self) -> None:
        """Hand the complete map to all sinks if it changed; the recording keeps it."""
        version = self._tiles.version
        if version == self._emitted_version:
            return
        self._emitted_version = version
        try:
            grid = self._tiles.grid()
        except StorageError as error:
            self._report(error)  # too large for one picture; the tiles are saved all the same
            return
        if grid is not None:
            unix_ns = self._unix_ns()
            self._emit(encode_grid(grid, unix_ns, unix_ns))

    def _wait(self) -> bool:
        """Until requested or it is time to look; False when there is nothing more to do."""
        with self._wake:
            if not self._requested and not self._stopping:
                self._wake.wait(min(EMIT_INTERVAL_S, 0.5 * self._checkpoint_s))
            return not self._stopping

    def _answer(self) -> None:
        with self._wake:
            requested, self._requested = self._requested, deque()
        if not requested:
            return
        if any(isinstance(one, _GraphRequest) or one.with_graph for one in requested):
            self._put_graph_away()
        to_save = [one for one in requested if isinstance(one, _Requested)]
        if to_save:
            self._save_for(to_save)
        for one in requested:
            if isinstance(one, _GraphRequest):
                one.then()

    def _save_for(self, requested: Sequence[_Requested]) -> None:
        saved = self.try_to_save()
        for one in requested:
            if not self.fault and one.number in self._ended:
                one.saved(*self._of_ended(one))
                continue
            if not one.name or self.fault:
                one.saved(saved, self.fault or self._delayed)
                continue
            try:
                one.saved(self._save_as(one.name), "")
            except StorageError as error:
                one.saved(None, str(error))

    def _of_ended(self, requested: _Requested) -> tuple[SavedMap | None, str]:
        saved, fault = self._ended[requested.number]
        if saved is None or not requested.name:
            return saved, fault
        return (
            None,
            f"not saved as {requested.name}: the map has ended meanwhile; it is stored in {saved.folder}",
        )

    def _put_graph_away(self) -> None:
        if not self._requests_graph or self._tiles.finest_count == 0:
            return
        before = self._tiles.graph
        if self._command("checkpoint", b"{}").ok and not self._tiles.wait_for_graph(before, GRAPH_S):
            log.warning(
                "%s: the graph was not put away within %.0f s; the map is saved with the one before",
                *(self.folder, GRAPH_S),
            )

    def _save_as(self, name: str) -> SavedMap | None:
        """The present map as the next version of a map of that name. Raises StorageError."""
        folder, present = self._directory / name, self._present
        if present is None or not present.tiles:
            return None
        if folder == self.folder:
            return self.newest
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(
                f"cannot save the map to {folder}: {words_of(error)}; choose another name"
            ) from error
        with InUse(folder, f"a session of {self._vehicle}"):
            about = self._about(present.number)
            number = save_map(folder, present.tiles, self._unix_ns(), about, present.geo, present.graph)
        assert number is not None
        return SavedMap(folder, number, present.version, present.geo, present.graph)

    def try_to_save(self) -> SavedMap | None:
        try:
            return self.save()
        except StorageError as error:
            self._report(error)
            return None

    def _report(self, error: StorageError) -> None:
        if str(error) != self.fault:  # once, not at every try
            log.error("%s", error)
        self.fault = str(error)


def _is_alive(graph_folder: Path) -> bool:
    """Whether the process that a graph folder is named by is there."""
    number = graph_folder.name.rpartition("-")[2]
    return number.isdigit() and Path("/proc", number).exists()
