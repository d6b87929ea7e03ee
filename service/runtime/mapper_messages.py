"""Messages between ingest and the mapper's process; see docs/decisions/0012-two-processes.md.

Everything that ingest hands to the mapper has a number, one more than the last, and is taken in that order.
Numbers, and what the mapper decided by the clock (`ResultApplied`, `PassedOver`), are all that a stand-by
needs to be taken again.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeGuard

from service.encoding import LASER_SCAN, Message
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapper.mapping_session import SessionAction
from service.mapper.saved_graph import KeptGraph
from service.outputs import GraphPicture, Grid, Reason, State, TileUpdate

MAX_AGE_NS = 50_000_000  # of a scan when its mapping begins, or two of its periods if that is more


class FrameItem(NamedTuple):
    """An encoded frame, as it is recorded."""

    number: int
    log_ns: int
    arrived_ns: int  # host monotonic, when its last byte was read
    sensor: str
    type: str
    payload: bytes


def is_sample(item: "Item") -> TypeGuard[FrameItem]:
    """Whether it only measures how the vehicle moves: without a scan after it nothing comes of it."""
    return isinstance(item, FrameItem) and item.type != LASER_SCAN


class SessionItem(NamedTuple):
    """A request to the mapping session: pause, resume, reset."""

    number: int
    log_ns: int
    action: SessionAction


class LoadItem(NamedTuple):
    """Begin again in a version of a stored map."""

    number: int
    log_ns: int
    folder: str
    version: int


class SwitchItem(NamedTuple):
    """Begin again, mapped by this section of a config."""

    number: int
    log_ns: int
    mapping: Mapping[str, Any]


class GraphItem(NamedTuple):
    """A request to the graph."""

    number: int
    log_ns: int
    name: str
    payload: Mapping[str, Any]


class TilesItem(NamedTuple):
    """Hand over all tiles up to here."""

    number: int
    log_ns: int


Item = FrameItem | SessionItem | LoadItem | SwitchItem | GraphItem | TilesItem


class Decisions(NamedTuple):
    """Decisions by the clock of a mapper that died, by the number of its next item."""

    applied: Mapping[int, int]  # how many results of the graph's back end it applied
    passed_over: frozenset[int]
    refused: frozenset[int]  # frames that a mapper died of


class Go(NamedTuple):
    """A stand-by takes over: all items after its own number are sent again. No output is sent twice."""

    done_number: int
    decisions: Decisions
    stays: bool = False  # also where its back end dies: that has happened again and again


class MakeStandby(NamedTuple):
    """The stand-by has died: make another one soon."""


class Finish(NamedTuple):
    """No more items come: finish the graph, hand over the last tiles, end."""


@dataclass(frozen=True, slots=True)
class Setup:
    """All that a mapper's process needs to begin."""

    mapping: Mapping[str, Any]  # the section of the config, as it can be written to YAML
    mountings: Mapping[str, SE2]  # pose_base_sensor of each laser
    lasers: tuple[str, ...]  # whose scans are mapped
    upside_down: frozenset[str]  # sensors that are mounted so
    graph_patience_s: float  # how long it may wait for the graph, all waits taken together
    log_level: int
    begin_in: str = ""  # folder of the stored map to begin in; "": a new map
    begin_version: int | None = None  # of that map; None: the current one
    graph_folder: str = ""  # where the graph is put away at each checkpoint; "": nowhere


class Hello(NamedTuple):
    """The first word of a process: the one that was started, or a stand-by of a mapper."""

    pid: int
    number: int  # the last item that it has taken
    is_standby: bool
    of_pid: int = 0  # of a stand-by: the mapper that it is a copy of


class GraphRendered(NamedTuple):
    """The graph of the present map, to be shown."""

    picture: GraphPicture


class StandingRendered(NamedTuple):
    """Static score around the vehicle, to be shown; see Mapper.standing."""

    grid: Grid
    stamp_ns: int  # Unix time of the newest scan in it


class ChangesRendered(NamedTuple):
    """Changes against the stored map in which the vehicle is localised; see MapChanges.as_grid."""

    grid: Grid
    stamp_ns: int  # Unix time of the newest scan that was mapped


class Progress(NamedTuple):
    """Kernels are being compiled; share of them that is, 0 to 1."""

    words: str
    share: float


class LongWork(NamedTuple):
    """Work that may take longer than a scan begins, or has ended; several may overlap."""

    has_begun: bool


class Ready(NamedTuple):
    """Kernels are there, and a stand-by where the profile can have one; frames are welcome."""

    has_standby: bool


class CanCopy(NamedTuple):
    """From here on there are stand-bys, or there are none any more: another profile maps."""

    can_copy: bool


class Mapped(NamedTuple):
    """A scan was mapped: what is published and recorded of it, with the time of its last byte."""

    number: int
    arrived_ns: int
    stamp_ns: int
    state: State
    reason: Reason
    inlier_ratio: float
    cpu_ns: int  # processor time of the mapper
    messages: tuple[Message, ...]  # pose first


class PassedOver(NamedTuple):
    """A scan that was too old to be mapped."""

    number: int
    log_ns: int
    sensor: str
    age_ns: int


class ResultApplied(NamedTuple):
    """A result of the graph's back end was applied before the item of this number, or is lost."""

    number: int
    log_ns: int
    fault: str


class PoseRefused(NamedTuple):
    """The pose that the operator set is rejected: the scans do not fit there."""

    log_ns: int
    pose: SE2


class Unusable(NamedTuple):
    """A frame that holds nothing to map."""

    number: int
    sensor: str
    is_mapped_scan: bool


class Answer(NamedTuple):
    """To a SessionItem (whether that changed anything), a GraphItem, a TilesItem."""

    number: int
    result: Any
    error: str = ""


class Tiles(NamedTuple):
    """Tiles that changed, and Unix time of the newest scan in them."""

    tiles: list[TileUpdate]
    stamp_ns: int


class Failed(NamedTuple):
    """The mapper failed at this item; its process ends after this message."""

    number: int
    words: str


class BackEndDied(NamedTuple):
    """The back end of the graph has died with its state; the stand-by has another one."""

    words: str


class Finished(NamedTuple):
    """Last message of a process that was requested to finish."""

    back_end_stood_still: bool


@dataclass(frozen=True, slots=True)
class Status:
    """State of the mapper, sent several times a second."""

    number: int  # the last item that it has taken
    counters: Mapping[str, int] = field(default_factory=dict)
    graph_fault: str = ""
    graph_behind_s: float = 0.0  # that the oldest key frames given to the back end have waited
    geo_reference: GeoReference | None = None  # where the map lies on the earth
    cpu_s: float = 0.0  # of the process since its start
    is_localizing: bool = False  # the map stays as it is
    time_warnings: tuple[str, ...] = ()  # faults of stamps and time fields, a sentence each


# Reported to the MapperListener.
Heard = (
    Mapped
    | PassedOver
    | ResultApplied
    | Unusable
    | Tiles
    | Status
    | KeptGraph
    | GraphRendered
    | StandingRendered
    | ChangesRendered
    | PoseRefused
)
FromMapper = Heard | Answer | Ready | CanCopy | Progress | LongWork | Finished
Fatal = Failed | BackEndDied  # the process ends by it, and its stand-by goes on
