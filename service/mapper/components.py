"""The seams of the mapper: what each component takes and gives. No algorithm lives here."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, NamedTuple, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from drivers.frames import GnssFix, LaserScan
from drivers.section import Section
from service.estimator.motion import Measurement, Motion, MotionModel, Prediction
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.kernels.usual_gap import usual_gap
from service.mapper.background import InlineWorker, NewWorker
from service.mapper.known_pose import KnownPose
from service.mapper.patch_store import MemoryPatches, NewPatchStore
from service.mapper.saved_graph import KeepGraph, KeptGraph, SavedGraph
from service.outputs import NO_REASON, GraphPicture, Reason, State, TileUpdate


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """End points of one scan, those without a return left out, in beam order."""

    xy_base: npt.NDArray[np.float64]  # (N, 2) m, base frame at one moment: the sweep's motion is taken out
    xy_raw: npt.NDArray[np.float64]  # (N, 2) m, base frame at each beam's own moment, by a constant twist
    beam_time_s: npt.NDArray[np.float64]  # (N,) since that moment; below 0 before it
    beam: npt.NDArray[np.int32]  # (N,) which beam of the scan
    sensor_base: SE2  # pose of the sensor in the base frame (pose_base_sensor)
    scan: LaserScan
    range_sigma_m: float = 0.01  # noise of a range, as the sensor has shown it so far
    usual_gap: int = 0  # beams from one return to the next, above 1 where not all are measured; 0: by `beam`

    def __post_init__(self) -> None:
        if not self.usual_gap:
            object.__setattr__(self, "usual_gap", usual_gap(self.beam))

    @property
    def spacing_rad(self) -> float:
        """From one return to the next."""
        return abs(self.scan.angle_step_rad) * self.usual_gap


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """What came of a scan; the same for every matcher. The state is the word of judgement.py.

    motion         where the base is held to be: matched, or as predicted
    points         deskewed with the matched twist
    inlier_ratio   share of the returns that lie on walls of the map
    state, reason  "lost": where the scan lies nobody knows
    submap         which one was matched to, where a method has several
    measured       pose, covariance and information by the scan; None: it was not matched, the motion is as
                   predicted
    is_contradicted  of a lost one: whether the map speaks against it; False: it may only see what the map
                   does not know
    is_moving      (N,) points that are not to be shown or kept: part of the scene moves; None: none
    advantage      of one that is only compared: agreement with known ground less that if the laser looked the
                   other way; None: not asked
    """

    motion: Motion
    points: Points
    inlier_ratio: float
    state: State = "ok"
    reason: Reason = NO_REASON
    submap: int | None = None
    measured: Measurement | None = None
    is_contradicted: bool = True
    is_moving: npt.NDArray[np.bool_] | None = None
    advantage: float | None = None


@dataclass(frozen=True, slots=True)
class MapChange:
    """What an insert did."""

    is_keyframe: bool = False
    error_left: float = 1.0  # share of the pose's error against the map that is left after the insert
    segment: int = 0  # connected piece of the map that the scan belongs to


@dataclass(frozen=True, slots=True, eq=False)
class MappedScan:
    """A scan in the local map, as a graph gets it: every one that was mapped, key frame or not."""

    stamp_ns: int
    points: Points  # deskewed with the matched twist
    match: Match
    change: MapChange
    covariance: npt.NDArray[np.float64]  # (3, 3) of the pose against the local map, base axes
    prior: npt.NDArray[np.float64]  # (3, 3) the same of the prediction
    elapsed_s: float = 0.0  # since the scan before
    is_motion_unmeasured: bool = False  # that since then, as in judgement.py


# Of a session in a stored map: nobody knows where it lies in it; one look says where; another one, too.
Placed = Literal["unknown", "unproven", "proven"]


@dataclass(frozen=True, slots=True)
class Correction:
    """Where a scan lies by the graph. Scans between two of them are bent along, see corrections.py."""

    stamp_ns: int
    pose_odom_base: SE2  # as the mapper gave it
    pose_map_base: SE2
    begins_segment: bool = False  # the vehicle was lost before it: nothing leads to it from the one before


@dataclass(frozen=True, slots=True, eq=False)
class RenderedMap:
    """The shown map drawn anew, to replace the old. Can be pickled."""

    tile_row: npt.NDArray[np.int64]  # (T,)
    tile_column: npt.NDArray[np.int64]  # (T,)
    evidence: npt.NDArray[np.int8]  # (T, W, W) of the free-space map that drew it
    wall_cells: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    # (K, 2) row and column of the cells in which a person has drawn a wall: no beam clears them
    is_part: npt.NDArray[np.bool_] | None = None  # (T, W, W) cells that are replaced; None: all of the map


@dataclass(frozen=True, slots=True, eq=False)
class ScanToRender:
    """A scan to be drawn into the shown map again."""

    xy_base: npt.NDArray[np.float32]  # (N, 2) m
    sensor_xy_m: tuple[float, float]  # in the base frame
    pose_map_base: SE2


@dataclass(frozen=True, slots=True, eq=False)
class AreaToErase:
    """An area, m in the map, in which a person has taken away what was drawn up to here."""

    corners_map: npt.NDArray[np.float64]  # (C, 2)
    is_free: bool  # it is known to be free then; else it is unknown


@dataclass(frozen=True, slots=True, eq=False)
class WallToRender:
    """A wall that a person has drawn, which stands whatever beams say."""

    corners_map: npt.NDArray[np.float64]  # (C, 2) m in the map, a line through these
    erased_map: Sequence[npt.NDArray[np.float64]] = ()  # (C, 2) each: areas in which it is erased again


ToRender = ScanToRender | AreaToErase | WallToRender


@dataclass(frozen=True, slots=True, eq=False)
class UnconfirmedPlace:
    """Where a piece of the map lies in the rest by one find, which nothing has confirmed yet.

    piece           its number
    pose_map_odom   for scans that are matched to it
    known           how well a key frame of it is known in the map, if the find is right
    """

    segment: int
    pose_map_odom: SE2
    known: KnownPose


@dataclass(frozen=True, slots=True)
class PossiblePlace:
    """A place of the map, one of several where the vehicle may be.

    nats    what speaks for it, against ground that the map does not hold
    least   nats that would exclude that ground; None: another place of the map is about as likely
    """

    x_m: float
    y_m: float
    nats: float
    least: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlaceNews:
    """What a graph knows of the vehicle's place in the map.

    placed         how sure the place of the session in its stored map is
    possible       where a piece that is looked for may be: two places about equally likely, or one that
                   unmapped ground may look like
    pose_refused   m, m, rad: where a person said the vehicle is, and what is seen does not fit; None: nothing
    found_once     where a piece was found; None: nowhere, or it is joined
    """

    placed: Placed = "proven"
    possible: Sequence[PossiblePlace] = ()
    pose_refused: tuple[float, float, float] | None = None
    unconfirmed_place: UnconfirmedPlace | None = None


@dataclass(frozen=True, slots=True)
class EditAnswer:
    """What became of a change of the map by hand, or of the mode.

    told    a JSON object: `done`, in words, and figures
    error   why it is not made, in words; "" where it is
    """

    reply: Mapping[str, Any] = field(default_factory=dict)
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class GraphUpdate:
    """What a piece of finished work changed, besides pose_map_odom.

    counts   counter -> how much it rose (or fell): loop_closures ...
    rendered_map    the shown map from now on; None: it stays
    since    what to draw into it besides: scans that the rendered map does not hold
    joined   number of a piece of the map that was found in the rest; None: none
    place    where in the map the vehicle is, as far as the graph knows; None: no news
    saved    what a later session needs to go on, where a checkpoint was asked for
    geo      where the map lies on the earth; None: that is not known, or not news
    picture  the graph, for people to look at; None: that of before stands
    known    how well a key frame is known in the map; None: no news, and at first the motion model alone
             says how well
    edited   the answer to a request that `Graph.request` took without one; None: this was no such work
    is_localizing   the map stays as it is from now on, or not any more; None: as before
    """

    counts: Mapping[str, int]
    rendered_map: RenderedMap | None = None
    since: Sequence[ScanToRender] = ()
    joined: int | None = None
    geo: GeoReference | None = None
    place: PlaceNews | None = None
    saved: SavedGraph | KeptGraph | None = None
    picture: GraphPicture | None = None
    known: KnownPose | None = None
    edited: EditAnswer | None = None
    is_localizing: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FinishedGraph:
    """The last word of a graph.

    corrections   by rising stamps; empty: map and odom are one frame for the whole session
    g2o           the graph as g2o text; "": there is none
    keyframes     poses of the drive in it; they stand first, and other poses behind them
    update        as that of apply_result
    """

    corrections: Sequence[Correction] = ()
    g2o: str = ""
    keyframes: int = 0
    update: GraphUpdate = GraphUpdate({})


class Deskew(Protocol):
    """Scan -> points, all at one moment."""

    def moment_of(self, scan: LaserScan) -> int:
        """At which the pose of the base says most of where its points are, ns."""

    def __call__(self, scan: LaserScan, motion: Motion, at_ns: int) -> Points:
        """at_ns   moment of the motion, to which the points are brought"""


class LocalMap(Protocol):
    """What a scan is matched to."""

    def insert(self, points: Points, match: Match) -> MapChange: ...

    def join(self, segment: int) -> None:
        """The graph has found where a piece of the map lies in the rest."""


@runtime_checkable
class Detachable(Protocol):
    """A local map that can begin anew where nobody knows the way, in a piece that is joined later."""

    def detach(self, pause_s: float) -> None:
        """Nobody measured the way for so long: what is seen from here on is a piece, until it is joined."""

    def attach(self) -> None:
        """Nobody looks for the place of a piece any more: scans are matched to the rest again."""


class Standing(NamedTuple):
    """Cells in which something stands, and for how long it has.

    xy_odom   (N, 2) float64   centres, m
    share     (N,)   float64   of the time from which on a thing counts in full; above 0, at most 1
    cell_m    float
    """

    xy_odom: npt.NDArray[np.float64]
    share: npt.NDArray[np.float64]
    cell_m: float


@runtime_checkable
class KnowsStanding(Protocol):
    """A local map that counts how long things stand."""

    def standing(self) -> Standing | None:
        """Of what scans are matched to now; None where nothing is counted."""


class Overlap(NamedTuple):
    """How many returns of a scan lie on walls of a map, and how many where it knows that nothing stands."""

    on_map: int
    in_free: int

    @property
    def agreement(self) -> float:
        """Share on walls of what ends on known ground; 1 where nothing is known, for nothing contradicts."""
        known = self.on_map + self.in_free
        return self.on_map / known if known else 1.0


class KnownMap(LocalMap, Protocol):
    """A local map that can be asked whether a scan fits."""

    @property
    def is_empty(self) -> bool: ...

    def overlap(self, xy_base: npt.NDArray[np.float64], pose: SE2) -> Overlap:
        """What the points of a scan, (N, 2) m in the base frame, meet at a pose in odom."""

    def start_over(self) -> None:
        """Be empty, and begin with the next scan."""


class MapRenderer(Protocol):
    """Draws the shown map from scratch, elsewhere: can be pickled."""

    def render(self, drawn: Iterable[ToRender]) -> RenderedMap:
        """One after the other; walls stand over all."""

    def render_part(self, drawn: Iterable[ToRender], corners_map: npt.NDArray[np.float64]) -> RenderedMap:
        """As render, of what may reach a polygon (C, 2) m: it replaces the cells within, and no others."""


class FreeSpaceMap(Protocol):
    """What is shown and driven on: occupancy in tiles, in the map frame."""

    @property
    def renderer(self) -> MapRenderer:
        """Draws as this map does."""

    def insert(self, points: Points, pose_map_base: SE2) -> None: ...

    def replace_by(self, rendered_map: RenderedMap, since: Sequence[ScanToRender]) -> None:
        """Show it in place of all, or of its part, and render `since` into it soon. Versions rise."""

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        """Tiles that changed since the last call, each with a new version; at most so many, the rest with the
        next call.
        """

    def tiles(self) -> list[TileUpdate]:
        """All tiles as they are now, for who only looks on: changed_tiles gives what it would have given."""


ReadableMap = TypeVar("ReadableMap", bound=LocalMap)
ReadableMap_contra = TypeVar("ReadableMap_contra", bound=LocalMap, contravariant=True)


class Matcher(Protocol[ReadableMap_contra]):
    """A matcher names the map type it can read, so a wrong pairing fails in mypy, not on the road."""

    def match(self, points: Points, predicted: Prediction, local_map: ReadableMap_contra) -> Match: ...

    def compare(self, points: Points, predicted: Prediction, local_map: ReadableMap_contra) -> Match:
        """The match of a scan without a say in pose and map; the default profile remembers nothing of it."""


class GraphRequestError(Exception):
    """Why a graph will not do what it is asked, in words for who asked."""


class Graph(Protocol):
    """Says where odom lies in the map. Whatever takes longer than a fraction of a scan is done elsewhere.

    Work goes out in `add` and `request`, and comes back in `apply_result`, which alone changes pose_map_odom.
    """

    @property
    def waiting(self) -> int:
        """Pieces of work that are out."""

    @property
    def ready(self) -> bool:
        """Whether apply_result would not wait. Only what runs live may ask: the answer depends on a clock."""

    @property
    def fault(self) -> str:
        """Why no work is done any more, "" while all is well. Mapping goes on without it."""

    @property
    def finds_segments(self) -> bool:
        """Whether it looks for where a piece of the map lies in the rest."""

    def add(self, scan: MappedScan) -> SE2:
        """Take a scan that was mapped, give the newest pose_map_odom. Does not wait."""

    def add_fix(self, fix: GnssFix) -> str:
        """Take a fix of a GNSS receiver; the name of the counter that it falls under. Does not wait."""

    def apply_result(self) -> GraphUpdate | None:
        """Bring in the oldest piece of work, waiting for it; None where none is out."""

    def request(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Do what a person asks for, such as "optimize"; what follows comes by apply_result.

        Both are JSON objects; None: the answer comes with a result, as `edited`. Raises GraphRequestError.
        """

    def finish(self) -> FinishedGraph:
        """Take in all that is out, do what is worth doing once at the end, and wait for it. Once, at last."""

    def close(self) -> None:
        """Nobody wants anything more."""


class Stopwatch(Protocol):
    """Times the components of a scan for the reader of a summary; has no say in any result."""

    def start(self) -> None: ...
    def lap(self, component: str) -> None: ...


@dataclass(frozen=True, slots=True)
class Components(Generic[ReadableMap]):
    """What fills the slots of one mapper."""

    motion_model: MotionModel
    deskew: Deskew
    matcher: Matcher[ReadableMap]
    local_map: ReadableMap
    graph: Graph
    free_space: FreeSpaceMap


Slot = Literal["motion_model", "deskew", "matcher", "local_map", "graph", "free_space"]
SLOTS: tuple[Slot, ...] = get_args(Slot)  # the fields of Components


@dataclass(frozen=True, slots=True)
class BuildContext:
    """What a component is told besides its own settings."""

    cell_m: float  # of the shown map
    mountings: Mapping[str, SE2]  # pose_base_sensor of each laser, by its name
    outline_m: Sequence[tuple[float, float]] = ()  # of the vehicle, base frame; what lies within is itself
    renderer: MapRenderer | None = None  # of the shown map; the graph is told, and only it
    new_worker: NewWorker = InlineWorker  # where back ends work
    new_patch_store: NewPatchStore = MemoryPatches  # where patches of a map wait that are far away
    stored: SavedGraph | None = None  # of the map that the session begins in
    is_localizing: bool = False  # that map stays as it is
    keep_graph: KeepGraph | None = None  # puts the graph away where a checkpoint is asked for; can be pickled


@dataclass(frozen=True, slots=True)
class ComponentKind:
    """Something that can fill a slot: its name in a config, its settings, and how it is made.

    makes     the class that build gives, where another component reads it (local maps); else None
    reads     the class of the local map that this component reads, None where it reads none
    begins_in_stored   of a graph: it can go on from BuildContext.stored, and gives what to store
    """

    name: str
    config: type[BaseModel]
    build: Callable[[Any, BuildContext], Any]
    makes: type | None = None
    reads: type | None = None
    begins_in_stored: bool = False


class NoSettings(Section):
    """Of a component that has nothing to set."""


@dataclass(frozen=True, slots=True)
class Method:
    """A page that says which components fill the slots, and with which settings where those are its own.

    settings   by slot: keys whose values differ from the defaults of the component
    others     by slot: further components that a config may choose
    """

    name: str
    components: Mapping[Slot, ComponentKind]
    settings: Mapping[Slot, Mapping[str, Any]]
    others: Mapping[Slot, Sequence[ComponentKind]] = field(default_factory=dict)
