"""The seam of the outputs: what the service offers a sink, and what a sink has to be.

A sink takes every message and every changed tile that leaves the service, and brings them somewhere: onto a
network, into a file, to a page. `registry.py` lists the kinds of sinks, `fan_out.py` serves the open ones.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

from drivers.link import LinkHealth
from service.encoding import Message, Status
from service.geometry.geo_reference import GeoReference
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.publishing.commands import Answer
from service.recording.session_change import SessionHeard

PartT = TypeVar("PartT")


class Shared:
    """What several sinks of one service use: for example a session. Sinks are opened one after the other."""

    def __init__(self) -> None:
        self._made: dict[type, object] = {}

    def of(self, part: type[PartT]) -> PartT:
        """The same for all; the first call makes it."""
        if part not in self._made:
            self._made[part] = part()
        made = self._made[part]
        assert isinstance(made, part)
        return made


@dataclass(frozen=True, slots=True)
class SinkContext:
    """What the service offers a sink when it is opened. Every callable may be called from any thread."""

    vehicle: str
    profile: str  # that the config names; `present_profile` after a switch
    stores_graph: bool  # whether a later session can go on in the map
    is_localizing: bool  # whether the map is a stored one that stays as it is
    start_unix_ns: int  # Unix time at which the service was constructed
    load_version: int | None  # of the stored map that the session begins in; None: it begins a new one
    map_folder: Path | None  # where this run's map is to be stored, if the caller requested a folder
    folders: Mapping[str, Path]  # section of the config -> its directory, of those that have one
    metadata: Mapping[str, Mapping[str, str]]  # name -> key -> text: version, config as YAML, clock
    tiles: TileStore  # the newest version of every tile of the map
    links: Mapping[str, LinkHealth]  # sensor name -> state of its link
    command: Callable[[str, bytes], Answer]  # verb and JSON -> answer; waits, in bounded time
    verbs: Callable[[], Sequence[str]]  # the commands that there are
    emit: Callable[[Message], None]  # hands a message to all sinks, the caller included
    unix_ns: Callable[[], int]  # the service's Unix time: host monotonic clock plus the offset of the start
    is_paused: Callable[[], bool]  # whether a command has paused the mapping
    present_profile: Callable[[], str]  # that maps now
    pose_sent: Callable[[int], None]  # takes ns from the last byte of a scan to its pose on the network
    shared: Shared = field(default_factory=Shared)  # what several sinks of this service use


class Sink(Protocol):
    """One output of the service, from `open` of its kind until `close`.

    `put`, `put_tiles`, `put_metadata` and `health` come from any thread, before `start` too, and never wait:
    what cannot go out at once waits in a queue of bounded size; what the queue cannot take is dropped and
    counted. Work is done in threads of the sink, named `<name>` or `<name>-...`: when one of them dies, the
    fan-out reports it in health, and mapping and the other sinks go on.
    """

    name: str  # of its row in health and of its threads
    wants_raw: bool = False  # whether bytes of the devices are to be put as messages "<sensor>/raw"

    @abstractmethod
    def put(self, message: Message, arrived_ns: int | None = None) -> None:
        """Take a message, or let it pass if this sink has no use for its channel.

        arrived_ns   for a pose: when its scan's last byte was read, host monotonic clock; else None
        """
        ...

    @abstractmethod
    def health(self) -> Status:
        """Its row in health, with the counters of what it sent and dropped."""
        ...

    @abstractmethod
    def close(self) -> None:
        """Bring out what waits and end every thread, before the deadline of the shutdown.

        Called once, after `flush`, also where `start` was never called or failed. Raises StorageError as
        `flush` does.
        """
        ...

    def start(self) -> None:
        """Begin: the mapper is ready, the drivers are not started yet. Raises StorageError.

        A sink that is complete when it is opened inherits this.
        """
        return

    def put_tiles(self, tiles: Sequence[TileUpdate], stamp_ns: int, log_ns: int) -> None:
        """Hear that tiles changed; the TileStore holds them already. Times are Unix time.

        stamp_ns   of the newest scan in the tiles
        log_ns     when the service had them

        A sink that brings no tiles out, or reads the TileStore at times of its own, inherits this.
        """
        return

    def put_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Hear that a part of `SinkContext.metadata` changed. A sink that keeps none inherits this."""
        return

    def flush(self) -> None:
        """Nothing is mapped any more: bring out what was kept back, and emit what all sinks should have.

        Ends before the deadline of the shutdown, or is left behind.

        Raises StorageError where something the run was made for is lost; the process then exits with 1.
        A sink that holds nothing back inherits this.
        """
        return

    def place(self) -> str:
        """Where its output is found: an endpoint, a folder, an address; "" while there is none."""
        return ""

    def status_words(self) -> str:
        """A few words for the status line of the service; "" for none."""
        return ""

    def written(self) -> list[Path]:
        """What it has completed on disk so far, oldest first."""
        return []


@runtime_checkable
class SessionRecorder(Protocol):
    """A sink that records sessions: what start_recording, stop_recording and mark need."""

    @property
    def why_not_recording(self) -> str:
        """Why what is put now is not kept; "" while it is."""

    def begin_session(self, first: Message, heard: SessionHeard) -> None: ...
    def end_session(self, heard: SessionHeard) -> None: ...


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map on disk."""

    folder: Path
    number: int  # of the version in its folder
    version: int  # of its newest tile
    geo: GeoReference | None = None  # where it lies on the earth
    graph: Path | None = None  # where what a session goes on with was taken from


SavedHeard = Callable[[SavedMap | None, str], None]  # the present map, None while it is empty; or the fault


@runtime_checkable
class MapStorage(Protocol):
    """A sink that stores maps: what save_map and reset_map need."""

    @property
    def folder(self) -> Path: ...

    @property
    def stored_folder(self) -> Path | None:
        """Of the present map, where a version of it is on disk; None: there is none yet."""
        ...

    @property
    def graph_folder(self) -> Path:
        """Where the mapper puts away what a later session goes on with; on the disk of the maps."""
        ...

    def folder_of(self, number: int) -> Path: ...
    def hold(self, folder: Path, version: int) -> None:
        """Keep others from changing a stored map in which this version is about to be begun in, and keep that
        version for replays. Raises StorageError.
        """
        ...

    def let_go(self, folder: Path) -> None:
        """It was reserved, and is not begun in. A map of this run that is saved there keeps it."""
        ...

    def begun_in(self, folder: Path) -> None:
        """The present map is that of this folder, which was reserved; call it when the one before has ended.

        Others may change the folder again when this map has ended and is saved.
        """
        ...

    def begun_new(self) -> None:
        """The present map is a new one; call it when the one before has ended, had it a tile or not."""
        ...

    def mapped_by(self, profile: str, stores_graph: bool) -> None:
        """The present map is a new one, made by this profile; call it when the one before has ended.

        stores_graph   whether a later session can go on in it
        """
        ...

    def ask_to_save(self, saved: SavedHeard, name: str = "", with_graph: bool = False) -> None:
        """Have the present map saved soon, under a name of its own besides if one is given.

        with_graph   what a session goes on with is put away before, as it is now

        Where too many requests wait, `saved` hears so at once, in the caller's thread.
        """
        ...

    def put_graph_away(self, then: Callable[[], None]) -> None:
        """Have what a session goes on with put away soon, as it is now, for the map to end. `then` is called
        when it is, or cannot be. Raises StorageError where too many requests wait; then it is never called.
        """
        ...
