"""A mapper that can be paused and restarted between two frames, live and in a replay alike."""

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

APPLY_AFTER_NS = 500_000_000  # of the drive: duration of a loop search on a busy machine

SessionAction = Literal["pause", "resume", "reset_map"]


@dataclass(frozen=True, slots=True)
class SessionRequest:
    """A request to the session, at its position among the frames: it affects those after it."""

    action: SessionAction
    arrived_ns: int  # as that of a frame


@dataclass(frozen=True, slots=True)
class LoadMap:
    """The session restarts in a stored map, at this position among the frames."""

    folder: str
    version: int
    arrived_ns: int


@dataclass(frozen=True, slots=True)
class SwitchProfile:
    """The session restarts with another profile, at this position among the frames."""

    profile: str
    arrived_ns: int


@dataclass(frozen=True, slots=True)
class ApplyResult:
    """Live, a result of the graph's back end was applied at this position among the frames."""

    arrived_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class GraphRequest:
    """A request of the operator to the graph, at this position among the frames: "optimize" ..."""

    name: str
    payload: Mapping[str, Any]  # a JSON object
    arrived_ns: int


@dataclass(frozen=True, slots=True)
class LeftOut:
    """Live, the next frame of a sensor was not mapped.

    "old" is a scan that waited too long, "fatal" a frame at which the mapper failed.
    """

    sensor: str
    reason: Literal["old", "fatal"]
    arrived_ns: int


# Events recorded among the frames.
Step = SessionRequest | LoadMap | SwitchProfile | ApplyResult | GraphRequest | LeftOut

# Names of the requests that go to the graph; the profile's graph decides which it supports.
GRAPH_REQUESTS = (
    *("add_landmark_pair", "remove_landmark_pair", "optimize", "undo", "set_pose", "checkpoint"),
    *("edit_map", "set_mode"),
)


class FrameMapper(Protocol):
    """service.mapper.pipeline.Mapper, for any local map."""

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
    """Maps frames and executes requests, in order. The same order gives the same outputs.

    Scans of lasers that are not among `lasers` are counted and dropped.

    During a pause no scan is mapped and no pose is published; samples still reach the motion model. A reset
    replaces the mapper: map and `pose_map_base` restart; `pose_odom_base` continues, since odom never jumps.

    apply_after_ns   a result of the graph's back end is applied with the first scan measured so long after
                     the scan that submitted its job; the session waits for it, so every replay is the same.
                     None: the caller applies results by apply_result: live when they are ready, in a replay
                     of a live session where the recording has them.
    """

    def __init__(
        self,
        new_mapper: Callable[[], FrameMapper],
        lasers: Collection[str],
        apply_after_ns: int | None = APPLY_AFTER_NS,
    ) -> None:
        self.lasers = frozenset(lasers)
        self._apply_after_ns = apply_after_ns
        self._sent_ns: deque[int] = deque()  # stamp of the scan that submitted each job
        self._new_mapper = new_mapper
        self._mapper = new_mapper()
        self._last_odom: tuple[int, SE2] | None = None  # stamp and pose of the newest output
        self._began: tuple[int, SE2] | None = None  # of the newest output before the last reset
        self.counters = self._mapper.counters  # of the mapper, continued over resets
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
        """Whether `process` would map the scan, if it is in order."""
        return scan.sensor in self.lasers and not self.paused

    def pass_over(self, scan: LaserScan) -> None:
        """Leave out a scan that is too old to be mapped: the pose follows wheels and gyro."""
        self.counters["scans_passed_over"] += 1
        self._mapper.skip(scan)

    def carry_out(self, action: SessionAction) -> bool:
        """Carry out a request; whether it changed anything: a pause in a pause does not."""
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
        """As Mapper.changed_tiles; versions restart with each reset."""
        return self._mapper.changed_tiles(most)

    def tiles(self) -> list[TileUpdate]:
        """As Mapper.tiles."""
        return self._mapper.tiles()

    def standing(self) -> Grid | None:
        """As Mapper.standing."""
        return self._mapper.standing()

    @property
    def geo_reference(self) -> GeoReference | None:
        """Geographic reference of the current map; None: not known (yet)."""
        return self._mapper.geo_reference

    @property
    def saved(self) -> SavedGraph | KeptGraph | None:
        """Graph of the newest checkpoint of the current map; None: there is none."""
        return self._mapper.saved

    @property
    def graph_picture(self) -> GraphPicture | None:
        """The graph of the current map, for display; None: none (yet)."""
        return self._mapper.graph_picture

    @property
    def pose_refused(self) -> tuple[float, float, float] | None:
        """m, m, rad: pose set by the operator that the scans contradict; None: none."""
        return self._mapper.pose_refused

    @property
    def work_ready(self) -> bool:
        """Whether apply_result would apply a result without waiting. For live operation only."""
        return self._mapper.graph.ready

    @property
    def map_changes(self) -> MapChanges | None:
        """As Mapper.map_changes."""
        return self._mapper.map_changes

    @property
    def changes_reported(self) -> MapChanges | None:
        """map_changes of some seconds ago, at no cost."""
        return self._mapper.changes_reported

    @property
    def is_localizing(self) -> bool:
        """Whether the current map stays as it is."""
        return self._mapper.is_localizing

    @property
    def graph_fault(self) -> str:
        """Why the graph stopped, "" if it runs."""
        return self._mapper.graph.fault

    def apply_result(self) -> None:
        """Apply the oldest result of the graph's back end, between two frames; waits for it."""
        self._mapper.apply_result()

    def request(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """As Graph.request. Raises GraphRequestError."""
        return self._mapper.graph.request(name, payload)

    def take_edited(self) -> list[EditAnswer]:
        """Answers since the last call to requests for which `request` returned None."""
        edited, self._mapper.edited = self._mapper.edited, []
        return edited

    def finish(self) -> FinishedGraph:
        """Graph.finish, in the odom of all outputs. Called before a reset or at the end; no frame follows."""
        finished = self._mapper.finish()
        if self._began is None:
            return finished
        start = self._began[1]
        corrections = [replace(c, pose_odom_base=start @ c.pose_odom_base) for c in finished.corrections]
        return replace(finished, corrections=corrections)

    def close(self) -> None:
        """Release the graph's back end."""
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
        pose_odom_start = self._began[1]  # origin of the map in odom
        return replace(
            output,
            pose_odom_base=pose_odom_start @ output.pose_odom_base,
            pose_map_odom=output.pose_map_odom @ pose_odom_start.inverse(),
        )
