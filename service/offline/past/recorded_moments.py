"""The moments of a recording: pose, scans, map and health as they were published then.

Nothing is mapped again. A moment is a log time: what the service had by then is known, what came later is
not. Read at once are the poses, the events and the health, and when a map or a graph came; scans, maps and
graphs are read when they are wanted.
"""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from shlex import quote

import numpy as np

from drivers.frames import LaserScan
from service import encoding
from service.errors import InputError
from service.geometry.poses import Floats
from service.geometry.se2 import SE2
from service.mapper.map_changes import NOTHING_CHANGED
from service.mapstore.tiles import tiles_of_grid
from service.offline.past.moments import STALE_NS, Moment, thinned
from service.outputs import NO_GRAPH, GraphPicture, Grid, TileUpdate
from service.recording.opening import name_of, open_recording
from service.web.live_view import MAX_EVENTS, MAX_PATH_POINTS, PATH_STEP_M, UNREPORTED, StatusSince, kind_of
from service.web.series import MAX_ROWS, PERIOD_S, FigureRows, Row

TOPICS = {
    "/pose": encoding.ODOMETRY,
    "/map": encoding.OCCUPANCY_GRID,
    f"/{encoding.GRAPH}": encoding.MARKERS,
    f"/{encoding.STANDING}": encoding.OCCUPANCY_GRID,
    f"/{encoding.CHANGES}": encoding.OCCUPANCY_GRID,
    "/diagnostics": encoding.DIAGNOSTICS,
    "/events": encoding.STRING,
    "/tf_static": encoding.TF,
}
NEW_MAP = ("reset_map", "load_map", "switch_profile")  # events with which another map and path begin
KEPT_TILINGS = 3


class RecordedMoments:
    """Raises InputError where the recording holds no poses of ours, and at a damaged place.

    progress    called with the share that is read
    """

    def __init__(self, paths: Sequence[Path], progress: Callable[[float], None] = lambda share: None) -> None:
        self._recording = recording = open_recording(paths)
        recorded = {t.name for t in recording.topics if t.count and TOPICS.get(t.name) == t.type}
        if "/pose" not in recorded:
            holds = ", ".join(map(str, recording.topics)) or "nothing"
            raise InputError(
                f"{recording.paths[0]}: no /pose ({encoding.ODOMETRY}) in it, so there is nothing to look "
                f"back at; it holds {holds}. Map it: corridor replay {quote(str(recording.paths[0]))} --web"
            )
        self._lasers = [
            topic.name
            for topic in recording.topics
            if topic.type == encoding.LASER_SCAN and topic.count and topic.name.count("/") == 2
        ]
        self._log_ns: defaultdict[str, list[int]] = defaultdict(list)  # by channel: when each message came
        self._new_map_log_ns: list[int] = []
        self._events: list[tuple[int, float, str]] = []  # log time, stamp in s, text
        self._health: list[tuple[int, Sequence[tuple[encoding.Status, float]]]] = []
        self._static: list[tuple[int, Mapping[str, SE2], frozenset[str]]] = []
        self._since = StatusSince()
        self.rows: list[Row] = []  # of figures, over all of it
        xy_map: list[tuple[float, float]] = []
        self._read(recorded, xy_map, progress)
        path_xy = np.array(xy_map, np.float64).reshape(-1, 2)
        rows = thinned(path_xy, PATH_STEP_M, MAX_PATH_POINTS)
        self.path_map: Floats = path_xy[rows]
        self._path_log_ns = [self._log_ns["pose"][row] for row in rows]
        self._tiles_of = lru_cache(KEPT_TILINGS)(self._read_tiles)
        self._graph_of = lru_cache(1)(self._read_graph)

    @property
    def first_ns(self) -> int:
        return self._recording.first_log_ns

    @property
    def last_ns(self) -> int:
        return self._recording.last_log_ns

    @property
    def name(self) -> str:
        """Name of the first file."""
        return name_of(self._recording.paths[0])

    @property
    def events(self) -> Sequence[tuple[float, str]]:
        """All of them, oldest first: Unix time, s, and text."""
        return [(seconds, text) for _, seconds, text in self._events]

    def at(self, at_ns: int) -> Moment:
        """Raises InputError at a damaged place."""
        mountings, upside_down = self._mountings(at_ns)
        window = list(self._recording.messages([*self._lasers, "/pose"], at_ns - STALE_NS, at_ns))
        scans = self._scans(window, upside_down)
        poses = [encoding.decode_pose(m.payload) for m in window if m.channel == "pose"]
        began = bisect_right(self._new_map_log_ns, at_ns)
        since_ns = self._new_map_log_ns[began - 1] if began else 0
        return Moment(
            at_ns=at_ns,
            poses=_around(poses, scans) or self._pose_before(at_ns),
            path=(bisect_right(self._path_log_ns, since_ns), bisect_right(self._path_log_ns, at_ns)),
            map_words=self._map_words(at_ns),
            scans=scans,
            mountings=mountings,
            graph=self._graph(at_ns),
            standing=self._grid(encoding.STANDING, at_ns, since_ns),
            changes=self._changes(at_ns, since_ns),
            statuses=self._statuses(at_ns),
            events=[(s, text) for log_ns, s, text in self._events if log_ns <= at_ns][-MAX_EVENTS:],
        )

    def tiles_at(self, at_ns: int) -> Sequence[TileUpdate]:
        """Tiles of the newest map that was recorded by then, if any. Raises InputError."""
        log_ns = self._newest("map", at_ns)
        return () if log_ns is None else self._tiles_of(log_ns)

    def _read(
        self, recorded: set[str], xy_map: list[tuple[float, float]], progress: Callable[[float], None]
    ) -> None:
        span_ns = max(self.last_ns - self.first_ns, 1)
        figures = FigureRows(max(PERIOD_S, span_ns / 1e9 / MAX_ROWS))
        for message in self._recording.messages(recorded):
            log_ns = message.log_ns
            self._log_ns[message.channel].append(log_ns)
            match message.channel:
                case "pose":
                    pose = encoding.decode_pose(message.payload)
                    xy_map.append((pose.pose.x_m, pose.pose.y_m))
                    figures.put_pose(pose)
                    figures.put_latencies([(log_ns - pose.stamp_ns) / 1e6])
                    progress((log_ns - self.first_ns) / span_ns)
                case "diagnostics":
                    statuses, stamp_s = encoding.decode_diagnostics(message.payload), message.stamp_ns / 1e9
                    self._health.append((log_ns, [(one, self._since.put(one, stamp_s)) for one in statuses]))
                    figures.put_health(statuses)
                case "events":
                    self._take_event(message)
                case "tf_static":
                    mountings = encoding.decode_mountings(message.payload)
                    self._static.append((log_ns, mountings, encoding.decode_upside_down(message.payload)))
            if (row := figures.row(log_ns / 1e9)) is not None:
                self.rows.append(row)
        progress(1.0)

    def _take_event(self, message: encoding.Message) -> None:
        text = encoding.decode_event(message.payload)
        if kind_of(text) in NEW_MAP:
            self._new_map_log_ns.append(message.log_ns)
        if kind_of(text) not in UNREPORTED:
            self._events.append((message.log_ns, message.stamp_ns / 1e9, text))

    def _mountings(self, at_ns: int) -> tuple[Mapping[str, SE2], frozenset[str]]:
        at = bisect_right(self._static, at_ns, key=lambda row: row[0])
        return ({}, frozenset()) if not at else self._static[at - 1][1:]

    def _scans(self, window: Sequence[encoding.Message], upside_down: frozenset[str]) -> list[LaserScan]:
        """The newest of each laser."""
        newest = {m.channel: m for m in window if m.type == encoding.LASER_SCAN}
        scans = []
        for channel, message in newest.items():
            sensor = channel.rpartition("/")[0]
            scan = encoding.decode_frame(
                message.type, message.payload, sensor, message.log_ns, sensor in upside_down
            )
            if isinstance(scan, LaserScan):
                scans.append(scan)
        return scans

    def _pose_before(self, at_ns: int) -> list[encoding.Pose]:
        log_ns = self._newest("pose", at_ns)
        return [] if log_ns is None else [encoding.decode_pose(self._message("/pose", log_ns).payload)]

    def _statuses(self, at_ns: int) -> Sequence[tuple[encoding.Status, float]]:
        at = bisect_right(self._health, at_ns, key=lambda row: row[0])
        if at:
            return self._health[at - 1][1]
        words = "no health was recorded by then"
        return [(encoding.Status("mapping", encoding.STALE, words, {"state": "not known"}), at_ns / 1e9)]

    def _map_words(self, at_ns: int) -> str:
        log_ns = self._newest("map", at_ns)
        return "no map was recorded by then" if log_ns is None else f"map recorded {_ago(at_ns - log_ns)}"

    def _graph(self, at_ns: int) -> GraphPicture:
        log_ns = self._newest(encoding.GRAPH, at_ns)
        return NO_GRAPH if log_ns is None else self._graph_of(log_ns)

    def _changes(self, at_ns: int, since_ns: int) -> Grid | None:
        """None in a recording without any; else the page would offer to show them."""
        if not self._log_ns[encoding.CHANGES]:
            return None
        return self._grid(encoding.CHANGES, at_ns, since_ns) or NOTHING_CHANGED

    def _grid(self, channel: str, at_ns: int, since_ns: int) -> Grid | None:
        """The newest by then, of the map that began at since_ns."""
        log_ns = self._newest(channel, at_ns)
        if log_ns is None or log_ns < since_ns:
            return None
        return encoding.decode_grid(self._message(f"/{channel}", log_ns).payload)

    def _read_tiles(self, log_ns: int) -> Sequence[TileUpdate]:
        return tiles_of_grid(encoding.decode_grid(self._message("/map", log_ns).payload))

    def _read_graph(self, log_ns: int) -> GraphPicture:
        return encoding.decode_graph(self._message(f"/{encoding.GRAPH}", log_ns).payload)

    def _message(self, topic: str, log_ns: int) -> encoding.Message:
        """The last of that log time."""
        *_, message = self._recording.messages([topic], log_ns, log_ns)
        return message

    def _newest(self, channel: str, at_ns: int) -> int | None:
        """Log time of the newest message by then; None: there is none."""
        at = bisect_right(self._log_ns[channel], at_ns)
        return self._log_ns[channel][at - 1] if at else None


def _around(poses: Sequence[encoding.Pose], scans: Sequence[LaserScan]) -> list[encoding.Pose]:
    """The newest, and of each scan the pose before it and the one after it; by rising stamps."""
    if not poses:
        return []
    ordered = sorted(poses, key=lambda pose: pose.stamp_ns)
    chosen = {len(ordered) - 1}
    for scan in scans:
        after = bisect_right(ordered, scan.stamp_ns, key=lambda pose: pose.stamp_ns)
        chosen |= {max(after - 1, 0), min(after, len(ordered) - 1)}
    return [ordered[k] for k in sorted(chosen)]


def _ago(age_ns: int) -> str:
    return "at this moment" if age_ns < 50_000_000 else f"{age_ns / 1e9:.1f} s before"
