"""Graph of the default profile: sends key frames to the loop back end, and applies its corrections."""

import json
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from pydantic import Field, ValidationError

from drivers.antenna import antenna_of
from drivers.frames import GnssFix
from drivers.section import Section
from service.geometry.se2 import SE2
from service.mapper.background import NewWorker
from service.mapper.components import (
    FinishedGraph,
    GraphRequestError,
    GraphUpdate,
    MappedScan,
    MapRenderer,
    ScanToRender,
)
from service.mapper.edit_requests import (
    EDIT_MAP,
    ONLY_LOCALISED,
    EditError,
    Erase,
    Wall,
    refuse_line,
    refuse_outline,
)
from service.mapper.graph.gnss.fix_track import FixTrack
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd, Result
from service.mapper.graph.model.background_graph import BackgroundGraph, add_counts
from service.mapper.graph.model.keyframe_list import KeyFrame, LoopsConfig
from service.mapper.graph.relocalise.detached_search import MAX_STATIONARY
from service.mapper.saved_graph import KeepGraph, SavedGraph

# Between key frames of a detached segment, also at standstill. After MAX_STATIONARY from one spot each
# interval is twice the one before, at most MAX_DOUBLED times: further scans add no evidence.
DETACHED_INTERVAL_NS, MAX_DOUBLED = 500_000_000, 4
# Key frames that wait for the back end, 90 m of path: with each so many, new ones are twice as far apart.
WAITING_PER_DOUBLING = 300

_NOTHING_ELSE = Batch([])
REQUESTS = ("optimize", "undo", "checkpoint", "set_pose", "edit_map", "set_mode")


class PoseRequest(Section):
    """Payload of set_pose: pose_map_base by the operator."""

    x_m: float = Field(allow_inf_nan=False)
    y_m: float = Field(allow_inf_nan=False)
    theta_rad: float = Field(allow_inf_nan=False)


class LoopClosing(BackgroundGraph[Result]):
    """Graph."""

    def __init__(
        self,
        config: LoopsConfig,
        renderer: MapRenderer | None,
        new_worker: NewWorker,
        mountings: Mapping[str, SE2] | None = None,
        stored: SavedGraph | None = None,
        is_localizing: bool = False,
        keep_graph: KeepGraph | None = None,
    ) -> None:
        """mountings: pose_base_sensor; a receiver's antenna is at "<sensor>/antenna", else at its sensor.

        stored, is_localizing, keep_graph   as of BuildContext
        """
        back_end = LoopBackEnd(config, renderer, stored, is_localizing, keep_graph)
        back_end.make_ready()
        super().__init__(back_end, new_worker)
        self._config = config
        self._mountings = mountings or {}
        self._fixes = FixTrack()
        self._keyframes = 0 if stored is None else len(stored)
        self._is_placed = stored is None
        self._is_localizing = is_localizing
        self._is_always_localizing = is_localizing  # set by the config, for the entire session
        self._is_detached = not self._is_placed  # the newest scan is in a detached segment
        self._fix_counts: Mapping[str, int] = {}  # of the newest result
        self._new_keyframes: list[KeyFrame] = []  # not yet sent
        self._sent: deque[list[KeyFrame]] = deque()  # with each job
        self._last: SE2 | None = None  # of the newest key frame
        self._segment = 0  # of the newest scan
        self._last_ns = 0
        self._stationary_pose: SE2 | None = None  # of the first key frame at standstill
        self._stationary_count = 0  # number of key frames after it at standstill
        self._gap_s = 0.0 if stored is None else math.inf  # longest scan gap since the last key frame
        self._is_unmeasured = False  # motion since the newest known place was not measured
        self._path_length_m = 0.0  # since the last batch
        self._last_result: Result | None = None
        self._pose_refused: tuple[float, float, float] | None = None
        self._loops = 0 if stored is None else len(stored.loop_ends)
        self._disabled = 0

    @property
    def finds_segments(self) -> bool:
        return not self.fault

    def add(self, scan: MappedScan) -> SE2:
        pose, self._segment = scan.match.motion.pose_odom_base, scan.change.segment
        self._gap_s = max(self._gap_s, scan.elapsed_s)
        self._is_unmeasured |= scan.is_motion_unmeasured
        is_detached = not self._is_placed or (scan.match.state == "lost" and scan.change.segment > 0)
        self._is_detached = is_detached
        wait_ns = DETACHED_INTERVAL_NS << min(max(self._stationary_count - MAX_STATIONARY, 0), MAX_DOUBLED)
        waiting = len(self._new_keyframes) + sum(map(len, self._sent))
        spacing = 1 << waiting // WAITING_PER_DOUBLING
        is_due = self._is_step(pose, self._last, spacing) or (
            is_detached and scan.stamp_ns - self._last_ns >= wait_ns * spacing
        )
        is_keyframe = len(scan.points.xy_base) and is_due and not self.fault
        if is_keyframe:
            if self._last is not None:
                self._path_length_m += math.hypot(pose.x_m - self._last.x_m, pose.y_m - self._last.y_m)
            self._last, self._last_ns = pose, scan.stamp_ns
            self._stationary_count += 1
            if self._is_step(pose, self._stationary_pose):
                self._stationary_pose, self._stationary_count = pose, 0
            self._new_keyframes.append(_key_frame(scan, self._gap_s, self._is_unmeasured))
            self._keyframes += 1
            self._gap_s = 0.0
        self._fixes.add_scan(scan.stamp_ns, pose, self._keyframes - 1)
        if is_keyframe and (
            self._path_length_m >= self._config.search_every_m or (is_detached and not self.waiting)
        ):
            self._submit()
        return self._pose_map_odom

    def add_fix(self, fix: GnssFix) -> str:
        if self.fault or self._is_localizing:
            return "fixes_passed_over"
        sensor = self._mountings.get(fix.sensor, SE2())
        antenna = self._mountings.get(antenna_of(fix.sensor), sensor)
        return self._fixes.add_fix(fix, (antenna.x_m, antenna.y_m))

    def request(self, name: str, payload: Mapping[str, Any]) -> Mapping[str, Any] | None:
        if name not in REQUESTS:
            raise GraphRequestError(f"{name}: the graph of this profile supports {', '.join(REQUESTS)}")
        if self.fault:
            raise GraphRequestError(f"{name}: no loops are closed any more: {self.fault}")
        if name == "set_pose":
            return self._set_pose(payload)
        answered_later = {"edit_map": self._edit, "set_mode": self._set_mode}
        if name in answered_later:
            answered_later[name](payload)
            return None
        if payload:
            raise GraphRequestError(f"{name} takes no arguments; it was given {', '.join(payload)}")
        if name == "undo" and not self._loops:
            raise GraphRequestError("undo: no loop is closed")
        self._submit(Batch([], name))
        return {"loop_closures": self._loops}

    def _set_pose(self, payload: Mapping[str, Any]) -> Mapping[str, Any]:
        try:
            requested = PoseRequest.model_validate(payload)
        except ValidationError as error:
            fault = error.errors()[0]
            raise GraphRequestError(f"set_pose: {'.'.join(map(str, fault['loc']))}: {fault['msg']}") from None
        if not self._is_detached:
            raise GraphRequestError(
                "set_pose: the pose is known and the map confirms it; it can be set where it is lost"
            )
        self._stationary_count = 0
        self._submit(Batch([], "set_pose", pose=(requested.x_m, requested.y_m, requested.theta_rad)))
        return {"looked_for_at": [requested.x_m, requested.y_m, requested.theta_rad]}

    def _edit(self, payload: Mapping[str, Any]) -> None:
        """Requests are validated here as far as possible, then by the back end."""
        if self._is_localizing:
            raise GraphRequestError(f"edit_map: {ONLY_LOCALISED}")
        try:
            change = EDIT_MAP.validate_json(json.dumps(payload)).change
            if isinstance(change, Erase):
                refuse_outline(np.array(change.corners).reshape(-1, 2))
            elif isinstance(change, Wall):
                refuse_line(np.array(change.corners).reshape(-1, 2))
        except ValidationError as error:
            fault = error.errors(include_url=False)[0]
            words = fault["msg"].removeprefix("Value error, ")
            raise GraphRequestError(f"edit_map: {'.'.join(map(str, fault['loc']))}: {words}") from None
        except EditError as error:
            raise GraphRequestError(f"edit_map: {error}") from error
        self._submit(Batch([], "edit_map", change=change))

    def _set_mode(self, payload: Mapping[str, Any]) -> None:
        mode = payload.get("mode")
        if mode not in ("mapping", "localization"):
            raise GraphRequestError(f"set_mode: mode is {mode!r}; expected mapping or localization")
        if mode == "mapping" and self._is_always_localizing:
            raise GraphRequestError(
                "set_mode: the config says mode: localization, so nothing of this map is saved; change the "
                "config and start the service again"
            )
        self._submit(Batch([], "set_mode", is_localizing=mode == "localization"))

    def finish(self) -> FinishedGraph:
        counts: dict[str, int] = {}
        self._apply_all(counts)
        if self.fault:
            return FinishedGraph(update=GraphUpdate(counts))
        self._submit(Batch([], is_last=True))
        update = self._apply_all(counts)
        last = self._last_result
        if self.fault or last is None:
            return FinishedGraph(update=GraphUpdate(counts))
        update = GraphUpdate(
            counts, update.rendered_map, geo=update.geo, saved=update.saved, picture=update.picture
        )
        return FinishedGraph(last.all, last.g2o, last.keyframes, update)

    def _submit(self, wanted: Batch = _NOTHING_ELSE) -> None:
        """Submit a request, with the key frames and fixes since the last batch."""
        self._jobs.submit(replace(wanted, frames=self._new_keyframes, fixes=self._fixes.take()))
        self._sent.append(self._new_keyframes)
        self._new_keyframes, self._path_length_m = [], 0.0

    def _give_up(self) -> None:
        self._sent.clear()
        self._new_keyframes.clear()

    def _bring_in(self, result: Result) -> GraphUpdate:
        self._sent.popleft()
        self._last_result = result
        counts = {
            "loop_closures": result.loops - self._loops,
            "loops_disabled": result.disabled - self._disabled,
        }
        self._loops, self._disabled = result.loops, result.disabled
        add_counts(counts, self._fixes.take_counts())
        add_counts(counts, {name: n - self._fix_counts.get(name, 0) for name, n in result.fixes.items()})
        self._fix_counts = result.fixes
        refused = result.place.pose_refused
        if refused not in (None, self._pose_refused):
            counts["set_pose_given_up"] = 1
        self._pose_refused = refused
        if result.is_localizing is not None and result.edited is not None:
            self._is_localizing = result.is_localizing
            # The back end drops key frames while it only localises: count them again.
            self._keyframes = result.keyframes + len(self._waiting_frames)
            self._fixes = FixTrack()
        self._is_placed = result.place.placed != "unknown"
        if result.joined is not None:
            self._is_unmeasured = False
        if result.newest:  # the first is the newest; the scan may be in a segment begun since
            correction = result.newest.get(self._segment, next(iter(result.newest.values())))
            self._pose_map_odom = correction.pose_map_base @ correction.pose_odom_base.inverse()
        is_all = result.rendered_map is not None and result.rendered_map.is_part is None
        rendered = [  # a partial map leaves them as they are
            ScanToRender(frame.xy_base, frame.sensor_xy_m, self._pose_map_odom @ frame.pose_odom_base)
            for frame in (self._waiting_frames if is_all else ())
        ]
        return GraphUpdate(
            counts,
            rendered_map=result.rendered_map,
            since=rendered,
            joined=result.joined,
            geo=result.geo,
            place=result.place,
            saved=result.saved,
            picture=result.picture,
            known=result.known,
            edited=result.edited,
            is_localizing=result.is_localizing,
        )

    @property
    def _waiting_frames(self) -> list[KeyFrame]:
        """Without a result of the back end yet, oldest first."""
        return [*chain.from_iterable(self._sent), *self._new_keyframes]

    def _is_step(self, pose: SE2, last: SE2 | None, spacing: int = 1) -> bool:
        """spacing: multiple of the distance and turn after which a key frame is due."""
        config = self._config
        distance_m, turn_rad = spacing * config.keyframe_distance_m, spacing * config.keyframe_turn_rad
        return last is None or pose.is_step_from(last, distance_m, turn_rad)


def _key_frame(scan: MappedScan, gap_s: float, is_unmeasured: bool) -> KeyFrame:
    points, match = scan.points, scan.match
    return KeyFrame(
        stamp_ns=scan.stamp_ns,
        pose_odom_base=match.motion.pose_odom_base,
        covariance=scan.covariance,
        segment=scan.change.segment,
        score=match.inlier_ratio,
        is_lost=match.measured is None and scan.change.segment == 0 and match.state == "lost",
        xy_base=points.xy_base.astype(np.float32),
        sensor_xy_m=(points.sensor_base.x_m, points.sensor_base.y_m),
        angle_step_rad=points.spacing_rad,
        range_sigma_m=points.range_sigma_m,
        gap_s=gap_s,
        motion_covariance=match.motion.covariance,
        is_unmeasured=is_unmeasured,
    )
