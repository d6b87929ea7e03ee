"""Data of the page, from the service's messages: the newest of each, and the path driven.

Any thread puts; the event loop takes what is due. Messages are decoded when they are due, not when they come:
most are replaced before.
"""

import json
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.frames import LaserScan
from service import encoding
from service.errors import InputError
from service.web.protocol import (
    FloatArray,
    encode_changes,
    encode_graph,
    encode_path,
    encode_scan,
    encode_standing,
    health_json,
    mountings_json,
    pose_json,
    series_json,
    to_json,
)
from service.web.send_queue import Payload
from service.web.series import FigureRows, Row

SCAN_PERIOD_NS = 200_000_000  # of one laser; five pictures a second look alive and take 20 kB
GRAPH_PERIOD_NS = 2_000_000_000  # at most 25 kB
KEPT_ROWS = 600  # ten minutes
MAX_EVENTS = 100
FRAMES = ("scan", "imu", "odom", "fix")  # what a sensor gives
# Counted in health, many a second.
UNREPORTED = (encoding.APPLY_RESULT, "scan_passed_over", "frame_refused", "frame_left_out")
MAX_PATH_PARTS = 200  # that wait to be shown
PATH_STEP_M = 0.05
# A pose farther away than a vehicle can have come: it was found elsewhere, and the path begins again there.
JUMP_M, FASTEST_MPS = 1.0, 20.0  # map_view.js has them, too
MAX_PATH_POINTS = 20_000  # 1 km at 5 cm; then every second point goes


@dataclass(frozen=True, slots=True)
class Shown:
    """A payload for every browser. key "": something that happened, which no newer payload replaces."""

    key: str
    payload: Payload


class StatusSince:
    """Its words may change each second, with the figures in them; level and state do not."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, str, float]] = {}

    def put(self, status: encoding.Status, stamp_s: float) -> float:
        """Since when the status has its level and state, Unix time."""
        how = (status.level, status.values.get("state", ""))
        if self._known.get(status.name, ())[:2] != how:
            self._known[status.name] = (*how, stamp_s)
        return self._known[status.name][2]


def kind_of(text: str) -> str:
    """Kind of an event; "" for text that is no event."""
    try:
        event = json.loads(text)
    except (ValueError, RecursionError):
        return ""
    kind = event.get("event") if isinstance(event, dict) else None
    return kind if isinstance(kind, str) else ""


class DrivenPath:
    """The path driven, thinned: points at least `step_m` apart, never more than `most`. A point of NaN stands
    where the pose jumped, between two stretches.
    """

    def __init__(self, step_m: float = PATH_STEP_M, most: int = MAX_PATH_POINTS) -> None:
        self._first_step_m = self._step_m = step_m
        self._most = most
        self._points: list[tuple[float, float]] = []

    def add(self, x_m: float, y_m: float) -> None:
        """Map frame."""
        if self._points and math.dist(self._points[-1], (x_m, y_m)) < self._step_m:
            return
        self._points.append((x_m, y_m))
        if len(self._points) > self._most:
            self._points = [xy for k, xy in enumerate(self._points) if k % 2 == 0 or math.isnan(xy[0])]
            self._step_m *= 2.0

    def leave_off(self) -> None:
        """Begin another stretch: the next point is not joined to the last."""
        if self._points and not math.isnan(self._points[-1][0]):
            self._points.append((math.nan, math.nan))

    def clear(self) -> None:
        self._points.clear()
        self._step_m = self._first_step_m

    def payload(self) -> bytes:
        return encode_path(np.array(self._points, dtype=np.float32).reshape(-1, 2))


@dataclass(slots=True)
class _Streams:
    """Messages that are not shown yet; guarded by the view's lock."""

    newest: dict[str, encoding.Message] = field(default_factory=dict)
    events: deque[encoding.Message] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    latencies_ns: deque[int] = field(default_factory=lambda: deque(maxlen=1000))
    path: FloatArray | None = None  # in place of the path so far
    stretches: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=MAX_PATH_PARTS))  # after it
    ready: dict[str, Payload] = field(default_factory=dict)  # by key


class LiveView:
    """The newest pose, scans, health, mountings and events, the path and figures over time.

    monotonic_ns    of the host, to give each laser's scans a period
    """

    def __init__(self, monotonic_ns: Callable[[], int]) -> None:
        self._monotonic_ns = monotonic_ns
        self._lock = threading.Lock()
        self._came = _Streams()
        self._arrival_ms: dict[str, float] = {}  # by sensor, of its newest frame
        self._upside_down: frozenset[str] = frozenset()
        self._since = StatusSince()
        self._due_ns: dict[str, int] = {}  # by channel that is shown seldom
        self._figures = FigureRows()
        self._rows: deque[Row] = deque(maxlen=KEPT_ROWS)
        self._events: deque[str] = deque(maxlen=MAX_EVENTS)
        self._kept: dict[str, Payload] = {}  # by key, for a browser that comes late
        self._path = DrivenPath()
        self._pose_before: encoding.Pose | None = None
        self.map_folders: list[Path] = []  # to which the service writes its map now
        self.unreadable = 0  # messages that did not decode

    def put(self, message: encoding.Message, origin_ns: int | None = None) -> None:
        """Take a message in; from any thread, in about a microsecond.

        origin_ns: of a pose, the moment its scan's last byte was read (host monotonic).
        """
        with self._lock:
            if message.channel == "events":
                self._came.events.append(message)
                return
            self._came.newest[message.channel] = message
            if origin_ns is not None:
                self._came.latencies_ns.append(self._monotonic_ns() - origin_ns)

    def due(self) -> list[Shown]:
        """Payloads that every browser should get now."""
        now_ns = self._monotonic_ns()
        came = self._take(now_ns)
        shown = self._show_path(came)
        shown += [self._keep(key, payload) for key, payload in came.ready.items()]
        for channel, message in came.newest.items():
            try:
                shown += self._show(channel, message)
            except InputError:  # a fault of ours: the service made them
                self.unreadable += 1
        for event in came.events:
            words = encoding.decode_event(event.payload)
            if kind_of(words) in UNREPORTED:
                continue
            text = to_json("event", stamp_s=event.stamp_ns / 1e9, text=words)
            self._events.append(text)
            shown.append(Shown("", text))
        return shown + self._show_row(came)

    def snapshot(self) -> list[Shown]:
        """All that a new browser needs, but for tiles."""
        return [
            Shown("path", self._path.payload()),
            Shown("series", series_json(self._rows)),
            *(Shown("", text) for text in self._events),
            *(Shown(key, payload) for key, payload in self._kept.items()),
        ]

    def put_path(self, points_map: FloatArray) -> None:
        """Take poses in place of the path so far; (N, 2), m, map frame. From any thread."""
        with self._lock:
            self._came.path = points_map
            self._came.stretches.clear()

    def put_stretch(self, points_map: FloatArray) -> None:
        """Take a stretch behind the path so far; (N, 2), m, map frame. From any thread."""
        with self._lock:
            self._came.stretches.append(points_map)

    def put_ready(self, payloads: Mapping[str, Payload]) -> None:
        """Take payloads that were made elsewhere, each in place of that of its key. From any thread."""
        with self._lock:
            self._came.ready.update(payloads)

    def map_reset(self) -> list[Shown]:
        """The map begins again, and with it the path, what stands and what has changed."""
        self._path.clear()
        self._pose_before = None
        return [
            Shown("path", self._path.payload()),
            self._keep(encoding.STANDING, encode_standing(None)),
            self._keep(encoding.CHANGES, encode_changes(None)),
        ]

    def _take(self, now_ns: int) -> _Streams:
        """Take the waiting messages. Scans whose laser was just shown stay, and a graph likewise."""
        with self._lock:
            came, self._came = self._came, _Streams()
            for channel in [c for c in came.newest if self._due_ns.get(c, 0) > now_ns]:
                self._came.newest[channel] = came.newest.pop(channel)
            for channel in came.newest:
                if channel.endswith("/scan"):
                    self._due_ns[channel] = now_ns + SCAN_PERIOD_NS
                elif channel == encoding.GRAPH:
                    self._due_ns[channel] = now_ns + GRAPH_PERIOD_NS
        return came

    def _show_path(self, came: _Streams) -> list[Shown]:
        shown = []
        if came.path is not None:
            self._kept.pop("path", None)  # that was made elsewhere
            self._path.clear()
            for x_m, y_m in came.path.tolist():
                self._path.add(x_m, y_m)
            shown.append(Shown("path", self._path.payload()))
        for stretch in came.stretches:
            for x_m, y_m in stretch.tolist():
                self._path.add(x_m, y_m)
            shown.append(Shown("", encode_path(stretch, goes_on=True)))
        return shown

    def _show(self, channel: str, message: encoding.Message) -> list[Shown]:
        sensor, _, kind = channel.rpartition("/")
        if sensor and kind in FRAMES:
            self._arrival_ms[sensor] = (message.log_ns - message.stamp_ns) / 1e6
        match sensor, kind:
            case "", "pose":
                return self._pose(message)
            case "", "diagnostics":
                return self._health(message)
            case "", "graph":
                return [self._keep("graph", encode_graph(encoding.decode_graph(message.payload)))]
            case "", "standing":
                return [self._keep(encoding.STANDING, encode_standing(encoding.decode_grid(message.payload)))]
            case "map", "changes":
                return [self._keep(encoding.CHANGES, encode_changes(encoding.decode_grid(message.payload)))]
            case "", "tf_static":
                return self._mountings(message)
            case _, "scan":
                return self._scan(message, sensor)
            case _:
                return []

    def _pose(self, message: encoding.Message) -> list[Shown]:
        pose, before = encoding.decode_pose(message.payload), self._pose_before
        if before is not None and _jumps(before, pose):
            self._path.leave_off()
        self._pose_before = pose
        self._figures.put_pose(pose)
        self._path.add(pose.pose.x_m, pose.pose.y_m)
        return [self._keep("pose", pose_json(pose))]

    def _scan(self, message: encoding.Message, sensor: str) -> list[Shown]:
        scan = encoding.decode_frame(
            message.type, message.payload, sensor, message.log_ns, sensor in self._upside_down
        )
        return [self._keep(f"scan/{sensor}", encode_scan(scan))] if isinstance(scan, LaserScan) else []

    def _health(self, message: encoding.Message) -> list[Shown]:
        statuses, stamp_s = encoding.decode_diagnostics(message.payload), message.stamp_ns / 1e9
        self._figures.put_health(statuses)
        self.map_folders = [
            Path(s.values["folder"]) for s in statuses if s.name == "map" and "folder" in s.values
        ]
        since = {status.name: self._since.put(status, stamp_s) for status in statuses}
        return [self._keep("health", health_json(statuses, since, self._arrival_ms, stamp_s))]

    def _mountings(self, message: encoding.Message) -> list[Shown]:
        self._upside_down = encoding.decode_upside_down(message.payload)
        edges = [
            edge for edge in encoding.decode_transforms(message.payload) if edge.frame == encoding.BASE_FRAME
        ]
        return [self._keep("mountings", mountings_json({edge.child: edge.pose for edge in edges}))]

    def _show_row(self, came: _Streams) -> list[Shown]:
        """Another row of figures, once it is due."""
        self._figures.put_latencies(ns / 1e6 for ns in came.latencies_ns)
        if not came.newest:
            return []
        row = self._figures.row(max(m.log_ns for m in came.newest.values()) / 1e9)
        if row is None:
            return []
        goes_on = not self._rows or row.stamp_s > self._rows[-1].stamp_s
        if not goes_on:
            self._rows.clear()  # a replay that has begun again
        self._rows.append(row)
        self._kept.pop("series", None)  # that was made elsewhere
        return [Shown("", series_json([row], goes_on))]

    def _keep(self, key: str, payload: Payload) -> Shown:
        self._kept[key] = payload
        return Shown(key, payload)


def _jumps(before: encoding.Pose, pose: encoding.Pose) -> bool:
    """Whether no vehicle can have driven from the one to the other."""
    seconds = abs(pose.stamp_ns - before.stamp_ns) / 1e9
    away_m = math.hypot(pose.pose.x_m - before.pose.x_m, pose.pose.y_m - before.pose.y_m)
    return away_m > JUMP_M + FASTEST_MPS * seconds
