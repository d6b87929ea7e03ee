"""A mapper that answers in place, and the frames, intake and mapping loop around it."""

import math
from collections import Counter

import numpy as np

from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.encoding import LogClock, Message
from service.geometry.se2 import SE2
from service.mapper.components import FinishedGraph, GraphUpdate
from service.mapper.map_changes import MapChanges
from service.mapper.mapping_session import MappingSession
from service.mapper.methods.shared import NoGraph
from service.mapstore.tiles import TileStore
from service.outputs import NO_REASON, GraphPicture, Grid, MapperOutput, TileUpdate
from service.runtime.host_time import HostTime
from service.runtime.intake import Intake
from service.runtime.mapper_messages import Answer
from service.runtime.mapping import PrepareMap, no_stored_maps
from service.runtime.mapping_outputs import MappingOutputs
from tests.service.runtime.inline_link import InlineLink

OFFSET_NS = 1_700_000_000_000_000_000
MS = 1_000_000


class FakeMapper:
    """Puts every scan one metre further along x; notes what it was given."""

    finished = False
    geo_reference = None

    saved = None

    def __init__(
        self, fault: Exception | None = None, x_m: float | None = None, graph: NoGraph | None = None
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.eaten: list[Frame] = []
        self.skipped = 0
        self._mapped = self._changed = 0
        self._fault = fault
        self._x_m = x_m
        self.graph = graph or NoGraph()

    def apply_result(self) -> None:
        self.eaten.append("apply_result")  # type: ignore[arg-type]
        self.graph.apply_result()

    def finish(self) -> FinishedGraph:
        self.finished = True
        return FinishedGraph()

    def process(self, frame: Frame) -> MapperOutput | None:
        self.eaten.append(frame)
        if not isinstance(frame, LaserScan):
            return None
        if self._fault is not None:
            raise self._fault
        self.counters["scans"] += 1
        self._mapped += 1
        self._changed = self._mapped
        x_m = float(self._mapped) if self._x_m is None else self._x_m
        pose = SE2(x_m, 0.0, 0.0)
        return MapperOutput(
            frame.stamp_ns, pose, SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0
        )

    def skip(self, scan: LaserScan) -> None:
        self.skipped += 1

    def standing(self) -> Grid | None:
        return self.stands

    stands: Grid | None = None
    graph_picture: GraphPicture | None = None
    pose_refused: tuple[float, float, float] | None = None
    changes_reported: MapChanges | None = None
    is_localizing = False

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        version, self._changed = self._changed, 0
        return [TileUpdate(0, 0, 0, version, 0.05, np.zeros((4, 4), np.int8))] if version else []


def scan(stamp_ns: int, arrived_ns: int, ranges: list[float], sensor: str = "front") -> LaserScan:
    range_m = np.array(ranges, dtype=np.float32)
    return LaserScan(sensor, stamp_ns, arrived_ns, 0, 3, 0.0, 0.1, 0.01, 20.0, range_m, NO_INTENSITY)


def sample(stamp_ns: int, arrived_ns: int) -> OdometrySample:
    return OdometrySample("base", stamp_ns, arrived_ns, 0.1, 0.2, 0.3, (0.0, 0.0, 0.0), (0.0,) * 9)


class Run:
    """An intake, a mapping loop and what comes of it."""

    def __init__(self, mapper: FakeMapper, prepare_map: PrepareMap = no_stored_maps) -> None:
        self.put_out: list[tuple[Message, int | None]] = []  # what the sinks were handed
        self.handed_over: list[tuple[int, int]] = []
        self.tiles = TileStore()
        fresh = iter([mapper])
        log_clock = LogClock()
        self.outputs = MappingOutputs(
            ["front"],
            self.tiles,
            self._put,
            self._hand_over,
            lambda: log_clock.next_ns(OFFSET_NS + 10**9),
            lambda: self.link.now_ns,
        )
        session = MappingSession(lambda: next(fresh, None) or FakeMapper(), ["front"], apply_after_ns=None)
        self.link = InlineLink(session, self.outputs, prepare_map=prepare_map)
        self.intake = Intake(self.link, HostTime(OFFSET_NS), self._put)  # type: ignore[arg-type]

    def put(self, *frames: Frame, waits_ns: int = 0) -> "Run":
        for frame in frames:
            self.link.now_ns = frame.arrived_ns + waits_ns
            self.intake.put(frame)
        return self

    def request(self, action: str) -> list[Answer]:
        """What the mapper answers to a command that is recorded as it is carried out."""
        answers: list[Answer] = []

        def carry_out(event: Message) -> None:
            self._put(event)
            self.intake.request_session(action, event.log_ns, answers.append)  # type: ignore[arg-type]

        assert self.intake.mark({"event": action}, carry_out) == ""
        return answers

    def channels(self) -> list[str]:
        return [m.channel for m in self.recorded if m.channel not in ("odom", "tf")]

    @property
    def recorded(self) -> list[Message]:
        return [message for message, _ in self.put_out]

    def _put(self, message: Message, arrived_ns: int | None = None) -> None:
        self.put_out.append((message, arrived_ns))

    def _hand_over(self, tiles: list[TileUpdate], stamp_ns: int) -> None:
        self.handed_over.append((tiles[-1].version, stamp_ns - OFFSET_NS))


FRAMES: list[Frame] = [sample(5, 30), scan(10, 20, [1.0, math.nan, 2.0]), scan(40, 60, [1.1, 1.2, 1.3])]


class GraphAtWork(NoGraph):
    """Has one job ready, or lost."""

    def __init__(self, lost: str = "") -> None:
        self.ready = True
        self._lost = lost

    def apply_result(self) -> GraphUpdate:
        self.ready, self.fault = False, self._lost
        return GraphUpdate({})
