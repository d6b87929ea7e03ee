"""A mapper that can be paused and begun anew between two frames, live and in a replay alike."""

from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

from drivers.frames import Frame, LaserScan
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapper.components import EditAnswer, FinishedGraph, Graph
from service.mapper.map_changes import MapChanges
from service.mapper.saved_graph import KeptGraph, SavedGraph
from service.outputs import GraphPicture, Grid, MapperOutput, TileUpdate

APPLY_AFTER_NS = 500_000_000  # of the drive: what a loop takes live on a busy machine

SessionAction = Literal["pause", "resume", "reset_map"]


@dataclass(frozen=True, slots=True)
class SessionRequest:
    """A request to the session with its place among the frames: it holds for those after it."""

    action: SessionAction
    arrived_ns: int  # as that of a frame


@dataclass(frozen=True, slots=True)
class LoadMap:
    """At this place among the frames the session begins anew, in a stored map."""

    folder: str
    version: int
    arrived_ns: int


@dataclass(frozen=True, slots=True)
class SwitchProfile:
    """At this place among the frames the session begins anew, with another profile."""

    profile: str
    arrived_ns: int


@dataclass(frozen=True, slots=True)
class ApplyResult:
    """Live, a result of the graph's back end was applied at this place among the frames."""

    arrived_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class GraphRequest:
    """What a person asked the graph for, at this place among the frames: "optimize" ..."""

    name: str
    payload: Mapping[str, Any]  # a JSON object
    arrived_ns: int


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Live, the next frame of a sensor was not mapped.

    "old" is a scan that had waited too long, "fatal" a frame that the mapper died of.
    """

    sensor: str
    reason: Literal["old", "fatal"]
    arrived_ns: int


# What stands among the frames.
Step = SessionRequest | LoadMap | SwitchProfile | ApplyResult | GraphRequest | LeftOut

# What the verbs are called that go to the graph; a profile's graph says which of them it knows.
GRAPH_REQUESTS = (
    *("add_landmark_pair", "remove_landmark_pair", "optimize", "undo", "set_pose", "checkpoint"),
    *("edit_map", "set_mode"),
)


class FrameMapper(Protocol):
    """service.mapper.pipeline.Mapper, whatever map it matches to."""

    counters: Counter[str]
    geo_reference: GeoReference | None
    saved: SavedGraph | KeptGraph | None
    graph_picture: GraphPicture | None
    changes_reported: MapChanges | None
    edited: list[EditAnswer]
    is_localizing: bool

    @property
    def map_changes(self) -> MapChanges | None: ...
    @property
    def pose_refused(self) -> tuple[float, float, float] | None: ...
    def process(self, frame: Frame) -> MapperOutput | None: ...
    def skip(self, scan: LaserScan) -> None: ...
    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]: ...
    def tiles(self) -> list[TileUpdate]: ...
    def standing(self) -> Grid | None: ...
    def apply_result(self) -> None: ...
    def finish(self) -> FinishedGraph: ...

    @property
    def graph(self) -> Graph: ...


class MappingSession:
    """Frames and requests in, outputs out. Same order in, same outputs out.

    Scans of lasers that are not among `lasers` are counted and pass.

    In a pause no scan is mapped and no pose comes out; samples go on to the motion model, so that it knows
    the way driven meanwhile. A reset puts a fresh mapper in the place of the old: map and `pose_map_base`
    begin anew, while `pose_odom_base` goes on where it was, because odom never jumps.

    apply_after_ns   a result of the graph's back end is applied with the first scan that was measured so
                     long after that with which its job went out, and is waited for then: the same in every
                     replay. None: the caller says when, by apply_result; live that is when it is ready, and
                     in a replay of that where the recording says so.
    """

    def __init__(
        self,
        new_mapper: Callable[[], FrameMapper],
        lasers: Collection[str],
        apply_after_ns: int | None = APPLY_AFTER_NS,
    ) -> None:
        self.lasers = frozenset(lasers)
        self._apply_after_ns = apply_after_ns
        self._sent_ns: deque[int] = deque()  # stamp of the scan with which each piece of work went out
        self._new_mapper = new_mapper
        self._mapper = new_mapper()
        self._last_odom: tuple[int, SE2] | None = None  # stamp and pose of the newest output
        self._began: tuple[int, SE2] | None = None  # that of the newest output before the last reset
        self.counters = self._mapper.counters  # those of the mapper, going on over resets
        self.paused = False

    def process(self, frame: Frame) -> MapperOutput | None:
        """As Mapper.process. A scan that is older than one mapped before a reset is dropped as late."""
        if not isinstance(frame, LaserScan):
            return self._mapper.process(frame)
        if frame.sensor not in self.lasers:
            self.counters["scans_not_mapped"] += 1
            return None
        if self._began is not None and frame.stamp_ns <= self._began[0]:
            self.counters["scans_dropped_late"] += 1
            return None
        if self.paused:
            self.counters["scans_paused"] += 1
            self._mapper.skip(frame)
            return None
        output = self._mapper.process(frame)
        if output is None:
            return None
        if self._apply_after_ns is not None:
            self._apply_old(output.stamp_ns - self._apply_after_ns, output.stamp_ns)
        output = self._in_one_odom(output)
        self._last_odom = (output.stamp_ns, output.pose_odom_base)
        return output

    def maps(self, scan: LaserScan) -> bool:
        """Whether `process` would map it, were it in order."""
        return scan.sensor in self.lasers and not self.paused

    def pass_over(self, scan: LaserScan) -> None:
        """Leave out a scan that is too old to be mapped: the base is where wheels and gyro say."""
        self.counters["scans_passed_over"] += 1
        self._mapper.skip(scan)

    def carry_out(self, action: SessionAction) -> bool:
        """Whether that changed anything: a pause in a pause does not."""
        if action == "reset_map":
            self._mapper.graph.close()
            self._sent_ns.clear()
            self._mapper = self._new_mapper()
            self._mapper.counters = self.counters
            self._began = self._last_odom
            self.counters["map_resets"] += 1
            return True
        paused, self.paused = self.paused, action == "pause"
        return self.paused != paused

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        """As Mapper.changed_tiles; versions begin anew with each reset."""
        return self._mapper.changed_tiles(most)

    def tiles(self) -> list[TileUpdate]:
        """As Mapper.tiles."""
        return self._mapper.tiles()

    def standing(self) -> Grid | None:
        """As Mapper.standing."""
        return self._mapper.standing()

    @property
    def geo_reference(self) -> GeoReference | None:
        """Where the present map lies on the earth; None: that is not known (yet)."""
        return self._mapper.geo_reference

    @property
    def saved(self) -> SavedGraph | KeptGraph | None:
        """Of the newest checkpoint of the present map that was asked for; None: there was none."""
        return self._mapper.saved

    @property
    def graph_picture(self) -> GraphPicture | None:
        """The graph of the present map, for people to look at; None where there is none (yet)."""
        return self._mapper.graph_picture

    @property
    def pose_refused(self) -> tuple[float, float, float] | None:
        """m, m, rad: where a person said that the vehicle is, and it is not; None: nothing."""
        return self._mapper.pose_refused

    @property
    def work_ready(self) -> bool:
        """Whether apply_result would apply something without waiting. Only what runs live may ask."""
        return self._mapper.graph.ready

    @property
    def map_changes(self) -> MapChanges | None:
        """As Mapper.map_changes."""
        return self._mapper.map_changes

    @property
    def changes_reported(self) -> MapChanges | None:
        """map_changes as they were some seconds ago; to ask for them costs nothing."""
        return self._mapper.changes_reported

    @property
    def is_localizing(self) -> bool:
        """Whether the present map stays as it is."""
        return self._mapper.is_localizing

    @property
    def graph_fault(self) -> str:
        """Why the graph does no work any more, "" while all is well."""
        return self._mapper.graph.fault

    def apply_result(self) -> None:
        """Apply the oldest result of the graph's back end, between two frames; waits for it."""
        self._mapper.apply_result()

    def request(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """As Graph.request. Raises GraphRequestError."""
        return self._mapper.graph.request(name, payload)

    def take_edited(self) -> list[EditAnswer]:
        """Answers to requests of which `request` gave None, that have come since the last call."""
        edited, self._mapper.edited = self._mapper.edited, []
        return edited

    def finish(self) -> FinishedGraph:
        """Graph.finish, in the odom of all outputs. Before a reset or at the end; then no frame more."""
        finished = self._mapper.finish()
        if self._began is None:
            return finished
        start = self._began[1]
        corrections = [replace(c, pose_odom_base=start @ c.pose_odom_base) for c in finished.corrections]
        return replace(finished, corrections=corrections)

    def close(self) -> None:
        """Nothing more is wanted of the graph's back end."""
        self._mapper.graph.close()

    def _apply_old(self, sent_until_ns: int, stamp_ns: int) -> None:
        while self._sent_ns and self._sent_ns[0] <= sent_until_ns:
            self._sent_ns.popleft()
            self._mapper.apply_result()
        out = self._mapper.graph.waiting - len(self._sent_ns)
        self._sent_ns.extend([stamp_ns] * max(out, 0))

    def _in_one_odom(self, output: MapperOutput) -> MapperOutput:
        if self._began is None:
            return output
        pose_odom_start = self._began[1]  # where the map began, in odom
        return replace(
            output,
            pose_odom_base=pose_odom_start @ output.pose_odom_base,
            pose_map_odom=output.pose_map_odom @ pose_odom_start.inverse(),
        )
