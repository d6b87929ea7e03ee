"""Interfaces of the mapper's components and the values between them. No algorithm is here."""

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
from service.mapper.background import InlineWorker, NewWorker
from service.mapper.known_pose import KnownPose
from service.mapper.patch_store import MemoryPatches, NewPatchStore
from service.mapper.saved_graph import KeepGraph, KeptGraph, SavedGraph
from service.outputs import NO_REASON, GraphPicture, Reason, State, TileUpdate


class Points(NamedTuple):
    """End points of the returns of one scan, in beam order."""

    xy_base: npt.NDArray[np.float64]  # (N, 2) m, base frame at one moment: deskewed
    xy_raw: npt.NDArray[np.float64]  # (N, 2) m, base frame at each beam's own moment, constant twist
    beam_time_s: npt.NDArray[np.float64]  # (N,) since that moment; negative before it
    beam: npt.NDArray[np.int32]  # (N,) beam index in the scan
    sensor_base: SE2  # pose of the sensor in the base frame (pose_base_sensor)
    scan: LaserScan
    range_sigma_m: float = 0.01  # noise of a range, estimated from the sensor's scans
    usual_gap: int = 1  # beams from one return to the next, above 1 where not all are measured

    @property
    def sensor_xy_m(self) -> npt.NDArray[np.float64]:
        """(2,) m, the sensor in the base frame."""
        return np.array([self.sensor_base.x_m, self.sensor_base.y_m])

    @property
    def spacing_rad(self) -> float:
        """Angle from one return to the next."""
        return abs(self.scan.angle_step_rad) * self.usual_gap


class Match(NamedTuple):
    """Result of matching a scan, the same for every matcher. judgement.py sets the state.

    motion         of the base: matched, or the prediction
    points         deskewed with the matched twist
    inlier_ratio   share of the returns that lie on walls of the map
    state, reason  "lost": the pose of the scan in the map is unknown
    submap         index of the matched sub-map, where a method has several
    measured       pose, covariance and information by the scan; None: unmatched, the motion is the prediction
    is_contradicted  of a lost scan: the map contradicts it; False: it may see unmapped ground only
    is_moving      (N,) points of moving objects, which are neither shown nor kept; None: none
    advantage      of a compared scan: agreement with known ground minus that of the laser turned round;
                   None: not computed
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
    """Effect of an insert into the local map."""

    is_keyframe: bool = False
    error_left: float = 1.0  # share of the pose's error against the map that remains after the insert
    segment: int = 0  # number of the map segment that the scan belongs to


class MappedScan(NamedTuple):
    """A mapped scan with its match in the local map, as the graph receives it, key frame or not."""

    stamp_ns: int
    points: Points  # deskewed with the matched twist
    match: Match
    change: MapChange
    covariance: npt.NDArray[np.float64]  # (3, 3) of the pose against the local map, base axes
    elapsed_s: float = 0.0  # since the scan before
    is_motion_unmeasured: bool = False  # no sensor measured the motion since the scan before


# Localisation of a session in a stored map: unknown, found from one viewpoint, confirmed from a second one.
Placed = Literal["unknown", "unproven", "proven"]


@dataclass(frozen=True, slots=True)
class Correction:
    """Pose of a scan by the graph. Scans between two corrections are interpolated, see corrections.py."""

    stamp_ns: int
    pose_odom_base: SE2  # of the mapper
    pose_map_base: SE2
    begins_segment: bool = False  # the vehicle was lost before it: no odometry leads to it


@dataclass(frozen=True, slots=True, eq=False)
class RenderedMap:
    """The shown map, rendered again, to replace the current one. Can be pickled."""

    tile_row: npt.NDArray[np.int64]  # (T,)
    tile_column: npt.NDArray[np.int64]  # (T,)
    evidence: npt.NDArray[np.int8]  # (T, W, W) log-odds steps of the free-space map
    wall_cells: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    # (K, 2) row and column of the cells of manual walls: no beam clears them
    is_part: npt.NDArray[np.bool_] | None = None  # (T, W, W) cells that are replaced; None: all of the map


@dataclass(frozen=True, slots=True, eq=False)
class ScanToRender:
    """A scan to be rendered into the shown map again."""

    xy_base: npt.NDArray[np.float32]  # (N, 2) m
    sensor_xy_m: tuple[float, float]  # in the base frame
    pose_map_base: SE2


@dataclass(frozen=True, slots=True, eq=False)
class AreaToErase:
    """An area in the map that the operator erased: it clears what was rendered before it."""

    corners_map: npt.NDArray[np.float64]  # (C, 2)
    is_free: bool  # free afterwards; else unknown


@dataclass(frozen=True, slots=True, eq=False)
class WallToRender:
    """A manual wall; beams do not clear it."""

    corners_map: npt.NDArray[np.float64]  # (C, 2) m in the map, a polyline
    erased_map: Sequence[npt.NDArray[np.float64]] = ()  # (C, 2) m each: areas erased later


ToRender = ScanToRender | AreaToErase | WallToRender


@dataclass(frozen=True, slots=True, eq=False)
class UnconfirmedPlace:
    """Place of a detached segment in the map by one search result, not confirmed yet.

    segment         its number
    pose_map_odom   for scans that are matched to it
    """

    segment: int
    pose_map_odom: SE2


@dataclass(frozen=True, slots=True)
class PossiblePlace:
    """A candidate place of the vehicle in the map.

    nats    log-likelihood ratio of the place to unmapped ground
    least   nats required to exclude unmapped ground; None: another place of the map is about as likely
    """

    x_m: float
    y_m: float
    nats: float
    least: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlaceUpdate:
    """Localisation of the vehicle in the map, by the graph.

    placed              of the session in its stored map
    possible            candidate places of a detached segment: two about equally likely, or one that unmapped
                        ground may resemble
    pose_refused        m, m, rad: pose set by the operator that the scans contradict; None: none
    unconfirmed_place   of a segment; None: none found, or the segment is joined
    """

    placed: Placed = "proven"
    possible: Sequence[PossiblePlace] = ()
    pose_refused: tuple[float, float, float] | None = None
    unconfirmed_place: UnconfirmedPlace | None = None


@dataclass(frozen=True, slots=True)
class EditAnswer:
    """Outcome of a manual change of the map, or of the mode.

    reply   a JSON object: `done`, a sentence, and figures
    error   why it was refused, "" if it was made
    """

    reply: Mapping[str, Any] = field(default_factory=dict)
    error: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class GraphUpdate:
    """Changes by a finished job of the graph, besides pose_map_odom.

    counts   counter -> increment (may be negative): loop_closures ...
    rendered_map    replaces the shown map; None: unchanged
    since    scans to render on top, which rendered_map does not contain
    joined   number of the segment that was joined to the map; None: none
    place    localisation of the vehicle in the map; None: unchanged
    saved    graph for a later session, if a checkpoint was requested
    geo      geographic reference of the map; None: unknown or unchanged
    picture  the graph, for display; None: unchanged
    known    covariance of a key frame in the map; None: unchanged, initially that of the motion model
    edited   the answer to a request that `Graph.request` left open; None: the job was no such request
    is_localizing   the map stays as it is from now on, or is updated again; None: unchanged
    """

    counts: Mapping[str, int]
    rendered_map: RenderedMap | None = None
    since: Sequence[ScanToRender] = ()
    joined: int | None = None
    geo: GeoReference | None = None
    place: PlaceUpdate | None = None
    saved: SavedGraph | KeptGraph | None = None
    picture: GraphPicture | None = None
    known: KnownPose | None = None
    edited: EditAnswer | None = None
    is_localizing: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FinishedGraph:
    """Final result of a graph.

    corrections   by ascending stamps; empty: map and odom are one frame for the entire session
    g2o           the graph as g2o text; "" if there is none
    keyframes     number of key-frame poses in it; they come first, other poses follow
    update        as of apply_result
    """

    corrections: Sequence[Correction] = ()
    g2o: str = ""
    keyframes: int = 0
    update: GraphUpdate = GraphUpdate({})


class Deskew(Protocol):
    """Converts a scan to points at one moment."""

    def moment_of(self, scan: LaserScan) -> int:
        """Moment of the base pose that the points depend on most, ns."""

    def __call__(self, scan: LaserScan, motion: Motion, at_ns: int, offset: SE2) -> Points:
        """at_ns    moment of `motion`; the points are given at it
        offset   of the laser from its configured mounting, base axes
        """


class LocalMap(Protocol):
    """The map that scans are matched to."""

    def insert(self, points: Points, match: Match) -> MapChange: ...

    def join(self, segment: int) -> None:
        """Use a detached segment as the map: the graph has found its pose in the map."""


@runtime_checkable
class Detachable(Protocol):
    """A local map that can begin a detached segment, which is joined later."""

    def detach(self, pause_s: float) -> None:
        """Begin a detached segment: the motion was not measured for pause_s."""

    def attach(self) -> None:
        """Drop detached segments and match to the map again: no graph searches for them any more."""


class Standing(NamedTuple):
    """Occupied cells and how long they have been observed.

    xy_odom   (N, 2) float64   centres, m
    share     (N,)   float64   of the duration from which on an object counts in full; above 0, at most 1
    cell_m    float            edge of a cell
    """

    xy_odom: npt.NDArray[np.float64]
    share: npt.NDArray[np.float64]
    cell_m: float


@runtime_checkable
class CountsStanding(Protocol):
    """A local map that counts how long cells stay occupied."""

    def standing(self) -> Standing | None:
        """Occupied cells of the current matching map; None where they are not counted."""


class Overlap(NamedTuple):
    """Number of returns of a scan on walls of a map, and in its free space."""

    on_map: int
    in_free: int

    @property
    def agreement(self) -> float:
        """Share on walls of the returns on known ground; 1 if there are none."""
        known = self.on_map + self.in_free
        return self.on_map / known if known else 1.0


class KnownMap(LocalMap, Protocol):
    """A local map that reports how well a scan fits."""

    @property
    def is_empty(self) -> bool: ...

    def overlap(self, xy_base: npt.NDArray[np.float64], pose: SE2) -> Overlap:
        """Overlap of the points of a scan, (N, 2) m in the base frame, with the map at a pose in odom."""

    def start_over(self) -> None:
        """Clear the map; the next scan begins it."""


class MapRenderer(Protocol):
    """Renders the shown map from scratch, in another process: can be pickled."""

    def render(self, items: Iterable[ToRender]) -> RenderedMap:
        """Render the items in order; walls of the operator last."""

    def render_part(self, items: Iterable[ToRender], corners_map: npt.NDArray[np.float64]) -> RenderedMap:
        """As render, for items that may reach a polygon (C, 2) m: only the cells within it are replaced."""


class FreeSpaceMap(Protocol):
    """The map for display and navigation: occupancy tiles in the map frame."""

    @property
    def renderer(self) -> MapRenderer:
        """A renderer with the settings of this map."""

    def insert(self, points: Points, pose_map_base: SE2) -> None: ...

    def replace_by(self, rendered_map: RenderedMap, since: Sequence[ScanToRender]) -> None:
        """Replace the map, or its part, and render `since` into it soon. Versions increase."""

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        """Tiles changed since the last call, at most `most`, each with a new version; the rest with the next
        call.
        """

    def tiles(self) -> list[TileUpdate]:
        """All tiles as they are now; does not affect changed_tiles."""


ReadableMap = TypeVar("ReadableMap", bound=LocalMap)
ReadableMap_contra = TypeVar("ReadableMap_contra", bound=LocalMap, contravariant=True)


class Matcher(Protocol[ReadableMap_contra]):
    """Names the map type it reads, so that a wrong pairing fails in mypy."""

    def match(self, points: Points, predicted: Prediction, local_map: ReadableMap_contra) -> Match: ...

    def compare(self, points: Points, predicted: Prediction, local_map: ReadableMap_contra) -> Match:
        """Match a scan without effect on pose and map; the default profile keeps no state of it."""


class GraphRequestError(Exception):
    """A graph refuses a request; the message is for the client."""


class Graph(Protocol):
    """Estimates pose_map_odom. Work longer than a fraction of a scan runs in a back end.

    `add` and `request` submit jobs; `apply_result` takes their results and alone changes pose_map_odom.
    """

    @property
    def waiting(self) -> int:
        """Number of submitted jobs."""

    @property
    def ready(self) -> bool:
        """Whether apply_result would return without waiting. Depends on a clock: for live operation only."""

    @property
    def fault(self) -> str:
        """Why the back end stopped, "" if it runs. Mapping continues without it."""

    @property
    def finds_segments(self) -> bool:
        """Whether it searches for the place of detached segments."""

    def add(self, scan: MappedScan) -> SE2:
        """Add a mapped scan and return the newest pose_map_odom. Does not wait."""

    def add_fix(self, fix: GnssFix) -> str:
        """Add a fix of a GNSS receiver; returns the counter it falls under. Does not wait."""

    def apply_result(self) -> GraphUpdate | None:
        """Apply the result of the oldest job, waiting for it; None if there is none."""

    def request(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Execute a request such as "optimize"; its results come by apply_result.

        Payload and answer are JSON objects; None: the answer comes with a result, as `edited`. Raises
        GraphRequestError.
        """

    def finish(self) -> FinishedGraph:
        """Apply all results, run the final optimisation and wait for it. Called once, last."""

    def close(self) -> None:
        """Release the back end."""


class Stopwatch:
    """Measures the duration of the components for a summary; affects no result. This one measures nothing."""

    def start(self) -> None: ...
    def lap(self, component: str) -> None: ...


@dataclass(frozen=True, slots=True)
class Components(Generic[ReadableMap]):
    """The components of one mapper."""

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
    """Inputs of a component besides its settings."""

    cell_m: float  # of the shown map
    mountings: Mapping[str, SE2]  # pose_base_sensor of each laser, by its name
    outline_m: Sequence[tuple[float, float]] = ()  # of the vehicle, base frame; returns within are dropped
    renderer: MapRenderer | None = None  # of the shown map; for the graph only
    new_worker: NewWorker = InlineWorker  # that runs back ends
    new_patch_store: NewPatchStore = MemoryPatches  # stores distant patches of a map
    stored: SavedGraph | None = None  # of the map that the session starts in
    is_localizing: bool = False  # the stored map is not changed
    keep_graph: KeepGraph | None = None  # stores the graph at a checkpoint; can be pickled


@dataclass(frozen=True, slots=True)
class ComponentKind:
    """A component that can fill a slot: its name in a config, its settings, and its constructor.

    makes     the class that build returns, if another component reads it (local maps); else None
    reads     the class of the local map that this component reads; None if it reads none
    begins_in_stored   of a graph: it can continue BuildContext.stored, and returns a graph to store
    """

    name: str
    config: type[BaseModel]
    build: Callable[[Any, BuildContext], Any]
    makes: type | None = None
    reads: type | None = None
    begins_in_stored: bool = False


class NoSettings(Section):
    """Of a component without settings."""


@dataclass(frozen=True, slots=True)
class Method:
    """A method: the component of each slot, and the method's own defaults.

    settings   by slot: keys whose values differ from the defaults of the component
    others     by slot: further components that a config may choose
    """

    name: str
    components: Mapping[Slot, ComponentKind]
    settings: Mapping[Slot, Mapping[str, Any]]
    others: Mapping[Slot, Sequence[ComponentKind]] = field(default_factory=dict)
