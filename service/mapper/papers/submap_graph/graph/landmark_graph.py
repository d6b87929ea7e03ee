"""The graph of the profile submap_graph: closed sub-maps go to the back end, corrections come back."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pydantic import Field, ValidationError

from drivers.frames import GnssFix
from drivers.section import Section
from service.geometry.se2 import SE2
from service.mapper.background import NewWorker
from service.mapper.components import (
    Correction,
    FinishedGraph,
    GraphRequestError,
    GraphUpdate,
    MappedScan,
    MapRenderer,
    ScanToRender,
)
from service.mapper.graph.model.background_graph import BackgroundGraph
from service.mapper.papers.submap_graph.counted_submaps import CountedChange
from service.mapper.papers.submap_graph.graph.landmark_back_end import (
    Batch,
    LandmarkBackEnd,
    LandmarkGraphConfig,
    Pair,
    Result,
)


class PointOfSubmap(Section):
    """A point of the published map, and the sub-map it belongs to."""

    submap: int = Field(ge=0)
    x_m: float = Field(allow_inf_nan=False)  # map frame
    y_m: float = Field(allow_inf_nan=False)


class PairRequest(Section):
    """Two points that are the same point of the world. Its name is that of the interface."""

    first: PointOfSubmap
    second: PointOfSubmap


class PairNumber(Section):
    pair: int = Field(ge=0)


class LandmarkGraph(BackgroundGraph[Result]):
    """Graph."""

    def __init__(
        self, config: LandmarkGraphConfig, renderer: MapRenderer | None, new_worker: NewWorker
    ) -> None:
        super().__init__(LandmarkBackEnd(config, renderer), new_worker)
        self._key_odom: dict[int, SE2] = {}  # by stamp of each key scan: pose by the mapper
        self._since: list[tuple[int, MappedScan]] = []  # key scans in no closed sub-map
        self._submaps = 0  # closed so far
        self._next_pair = 0
        self._pairs: list[Pair] = []
        self._last: Result | None = None

    def add(self, scan: MappedScan) -> SE2:
        change = scan.change
        if change.is_keyframe:
            self._key_odom[scan.stamp_ns] = scan.match.motion.pose_odom_base
            self._since.append((self._submaps, scan))
        if isinstance(change, CountedChange) and change.closed is not None:
            self._submaps += 1
            self._jobs.submit(Batch("submap", closed=change.closed))
        return self._pose_map_odom

    def add_fix(self, fix: GnssFix) -> str:
        return "fixes_passed_over"

    def request(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any]:
        """add_landmark_pair, remove_landmark_pair, optimize, undo. The answer lists the present graph."""
        if self._jobs.fault:
            raise GraphRequestError(f"{name}: the graph has stopped: {self._jobs.fault}")
        answer: dict[str, Any] = {}
        if name == "add_landmark_pair":
            pair = self._new_pair(name, payload)
            self._pairs.append(pair)
            self._jobs.submit(Batch("add", pair=pair))
            answer["pair"] = pair.number
        elif name == "remove_landmark_pair":
            number = _read(PairNumber, name, payload).pair
            self._drop(name, "remove", number)
        elif name == "undo":
            if not self._pairs:
                raise GraphRequestError("undo: there is no landmark pair to take back")
            answer["pair"] = self._pairs[-1].number
            self._drop(name, "undo", self._pairs[-1].number)
        elif name == "optimize":
            self._jobs.submit(Batch("optimize"))
        else:
            raise GraphRequestError(
                f"{name}: this graph knows add_landmark_pair, remove_landmark_pair, optimize, undo"
            )
        return answer | self._known()

    def finish(self) -> FinishedGraph:
        counts: dict[str, int] = {}
        if not self.fault:
            self._jobs.submit(Batch("finish"))
        update = self._apply_all(counts)
        result = self._last
        if result is None or not len(result.stamps):
            return FinishedGraph(update=replace(update, counts=counts))
        corrections = [
            Correction(stamp_ns, self._key_odom[stamp_ns], SE2(*pose))
            for stamp_ns, pose in zip(result.stamps.tolist(), result.poses.tolist(), strict=True)
        ]
        return FinishedGraph(corrections, result.g2o, result.keyframes, replace(update, counts=counts))

    def _bring_in(self, result: Result) -> GraphUpdate:
        before, self._last = self._last, result
        self._pose_map_odom = result.pose_map_odom
        self._since = [(number, scan) for number, scan in self._since if number >= result.submaps]
        since: list[ScanToRender] = []
        if result.rendered_map is not None:
            since = [
                ScanToRender(
                    scan.points.xy_base.astype("float32"),
                    (scan.points.sensor_base.x_m, scan.points.sensor_base.y_m),
                    self._pose_map_odom @ scan.match.motion.pose_odom_base,
                )
                for _number, scan in self._since
            ]
        links = before.links if before is not None else 0
        return GraphUpdate(
            {"loop_closures": result.links - links}, result.rendered_map, since, picture=result.picture
        )

    def _new_pair(self, name: str, payload: Mapping[str, Any]) -> Pair:
        request = _read(PairRequest, name, payload)
        points = (request.first, request.second)
        if points[0].submap == points[1].submap:
            raise GraphRequestError(
                f"{name}: both points are of sub-map {points[0].submap}; name two sub-maps"
            )
        known = self._last.submaps if self._last is not None else 0
        for point in points:
            if point.submap >= known:
                raise GraphRequestError(
                    f"{name}: there is no sub-map {point.submap} in the graph yet; it holds {known}, "
                    "numbered from 0 along the path"
                )
        number = self._next_pair
        self._next_pair += 1
        first, second = points
        xy = (first.x_m, first.y_m), (second.x_m, second.y_m)
        return Pair(number, (first.submap, second.submap), xy)

    def _drop(self, name: str, what: Any, number: int) -> None:
        pair = next((pair for pair in self._pairs if pair.number == number), None)
        if pair is None:
            known = ", ".join(str(pair.number) for pair in self._pairs) or "none"
            raise GraphRequestError(f"{name}: there is no landmark pair {number}; there are: {known}")
        self._pairs.remove(pair)
        self._jobs.submit(Batch(what, pair=pair))

    def _known(self) -> dict[str, Any]:
        last = self._last
        return {
            "submaps": last.submaps if last is not None else 0,
            "links": last.links if last is not None else 0,
            "landmarks": last.landmarks if last is not None else 0,
            "rms_m": round(last.rms_m, 4) if last is not None else 0.0,
            "pairs": [
                {"pair": pair.number, "apart_m": round(last.residual_m[pair.number], 4)}
                for pair in self._pairs
                if last is not None and pair.number in last.residual_m
            ],
            "fault": last.fault if last is not None else "",
            "waiting": self._jobs.waiting,
        }


def _read(model: Any, name: str, payload: Mapping[str, Any]) -> Any:
    try:
        return model.model_validate(payload)
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(map(str, fault["loc"])) or "the request"
        raise GraphRequestError(f"{name}: {place}: {fault['msg']}") from None
