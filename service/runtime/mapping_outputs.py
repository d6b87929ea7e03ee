"""Messages of the mapper's process: passed to the sinks, stored as tiles, and counted."""

import json
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, assert_never

from service.encoding import APPLY_RESULT, CHANGES, STANDING, Message, encode_event, encode_graph, encode_grid
from service.geometry.geo_reference import GeoReference
from service.mapper.saved_graph import KeptGraph
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.runtime import mapper_messages as msg
from service.runtime.metrics import LatencyHistogram

log = logging.getLogger(__name__)

OVERLOAD_SCANS = 3  # so many that were passed over are an overload; one or two are only counted
OVERLOAD_NS = 10_000_000_000  # so long without one that was passed over ends it


@dataclass(frozen=True, slots=True)
class _Overload:
    """Scans that were passed over, none more than OVERLOAD_NS after the one before; host monotonic."""

    first_ns: int
    last_ns: int = 0
    scans: int = 0
    oldest_age_ns: int = 0


class MappingOutputs:
    """MapperListener. Written by the thread that listens to the mapper, `left_out` by readers; read by any.

    put         takes a message and, for a pose, the moment its scan's last byte was read (host monotonic, ns)
    put_tiles   takes tiles that the store holds by now, and the Unix time of the scan they are up to
    log_ns      a log time after all before
    """

    def __init__(
        self,
        lasers: Sequence[str],
        tiles: TileStore,
        put: Callable[[Message, int | None], Any],
        put_tiles: Callable[[list[TileUpdate], int], Any],
        log_ns: Callable[[], int],
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.lasers = tuple(lasers)  # whose scans are mapped
        self._tiles = tiles
        self._put = put
        self._put_tiles = put_tiles
        self._log_ns = log_ns
        self._monotonic_ns = monotonic_ns
        self._began_version = 0  # versions of the mapper's tiles count from here
        self._counting = threading.Lock()  # of _overload and passed_over
        self._overload: _Overload | None = None  # the newest, over or not
        self.counters: Mapping[str, int] = {}  # the mapper's own: scans, scans_dropped_late ...
        self.graph_fault = ""  # why no loop is closed any more, "" while loops are closed
        self.graph_behind_s = 0.0  # as of Status
        self.time_warnings: tuple[str, ...] = ()  # faults of stamps and time fields
        self.is_localizing = False  # the map stays as it is
        self.last: msg.Mapped | None = None
        self.last_ns = 0  # when that came, host monotonic
        self.geo_reference: GeoReference | None = None
        self.states: Counter[str] = Counter()  # scans by state: ok, degraded, lost
        self.scan_cpu = LatencyHistogram()  # processor time in the mapper, by scan mapped
        self.unusable_scans = 0  # of the lasers that are mapped
        self.unusable: Counter[str] = Counter()  # frames that hold nothing to map, by sensor
        self.passed_over: Counter[str] = Counter()  # scans too old, or with too many items ahead, by sensor
        self.restarts = 0  # of the mapper
        self.restart_reason = ""
        self.cpu_s = 0.0  # of the mapper's processes
        self._cpu_before_s = 0.0

    def heard(self, message: msg.Heard) -> None:
        match message:
            case msg.Mapped():
                self._mapped(message)
            case msg.Tiles():
                self._take_tiles(message)
            case msg.Status():
                self._take_status(message)
            case msg.ResultApplied():
                self._graph_worked(message)
            case msg.PassedOver():
                self._scan_passed_over(message)
            case msg.PoseRefused():
                self._pose_refused(message)
            case KeptGraph():
                self._graph_kept(message)
            case msg.GraphRendered():
                self._put(encode_graph(message.picture, self._log_ns()), None)
            case msg.StandingRendered():
                self._put(encode_grid(message.grid, message.stamp_ns, self._log_ns(), STANDING), None)
            case msg.ChangesRendered():
                self._put(encode_grid(message.grid, message.stamp_ns, self._log_ns(), CHANGES), None)
            case msg.Unusable():
                self.unusable[message.sensor] += 1
                self.unusable_scans += message.is_mapped_scan
            case _:
                assert_never(message)

    def taken_over(self, words: str) -> None:
        self.restarts += 1
        self.restart_reason = words
        self._began_version = self._tiles.version
        self._cpu_before_s = self.cpu_s
        log_ns = self._log_ns()
        event = {"event": "mapper_restarted", "reason": words}
        self._put(encode_event(json.dumps(event), log_ns, log_ns), None)

    def refused(self, item: msg.FrameItem) -> None:
        self._put_before(item.log_ns, {"event": "frame_refused", "sensor": item.sensor})

    def left_out(self, item: msg.FrameItem) -> None:
        if item.sensor in self.lasers and not msg.is_sample(item):
            self._count_left_out(item.sensor, 0)
        self._put_before(item.log_ns, {"event": "frame_left_out", "sensor": item.sensor})

    def map_reset(self) -> int | None:
        """The mapper has begun a new map; the tiles of the old one are emptied for all.

        Number of the old one in the TileStore; None where it had no tile.
        """
        ended = self._tiles.number
        emptied = self._tiles.start_over()
        if emptied:
            self._put_tiles(emptied, self._map_stamp_ns)
        self._began_version = self._tiles.version
        self.last = self.geo_reference = None
        return ended if emptied else None

    def overload(self) -> str:
        """The reason, with figures, where scans come faster than they are mapped; else ""."""
        overload, now_ns = self._overload, self._monotonic_ns()
        if overload is None or overload.scans < OVERLOAD_SCANS or now_ns - overload.last_ns > OVERLOAD_NS:
            return ""
        return (
            f"{overload.scans} scans in {(now_ns - overload.first_ns) / 1e9:.1f} s were not mapped, having "
            f"waited up to {overload.oldest_age_ns / 1e6:.0f} ms (expected at most "
            f"{msg.MAX_AGE_NS / 1e6:.0f} ms, or two periods of the laser); the pose follows the "
            "prediction meanwhile. Does another program take the processor?"
        )

    @property
    def _map_stamp_ns(self) -> int:
        return self.last.stamp_ns if self.last is not None else 0

    def _mapped(self, mapped: msg.Mapped) -> None:
        self.last, self.last_ns = mapped, self._monotonic_ns()
        self.states[mapped.state] += 1
        self.scan_cpu.add(mapped.cpu_ns)
        log_ns = self._log_ns()
        for k, message in enumerate(mapped.messages):
            stamped = replace(message, log_ns=log_ns)
            self._put(stamped, mapped.arrived_ns if k == 0 else None)

    def _take_status(self, status: msg.Status) -> None:
        self.counters, self.graph_fault = status.counters, status.graph_fault
        self.graph_behind_s = status.graph_behind_s
        self.time_warnings, self.is_localizing = status.time_warnings, status.is_localizing
        self.cpu_s = self._cpu_before_s + status.cpu_s
        if status.geo_reference != self.geo_reference:
            self.geo_reference = status.geo_reference
            self._tiles.place(status.geo_reference)

    def _take_tiles(self, message: msg.Tiles) -> None:
        tiles = [replace(tile, version=self._began_version + tile.version) for tile in message.tiles]
        self._tiles.update(tiles)
        self._put_tiles(tiles, message.stamp_ns)

    def _graph_worked(self, message: msg.ResultApplied) -> None:
        fault = message.fault
        event = {"event": "graph_lost", "reason": fault} if fault else {"event": APPLY_RESULT}
        self._put_before(message.log_ns, event)

    def _pose_refused(self, refused: msg.PoseRefused) -> None:
        log.warning(
            "set_pose: the pose (%.2f, %.2f) m, %.2f rad is rejected: no scan matches the map there; "
            "set another one, or drive on",
            *refused.pose,
        )
        self._put_before(refused.log_ns, {"event": "set_pose_given_up", **refused.pose._asdict()})

    def _graph_kept(self, kept: KeptGraph) -> None:
        if kept.fault:
            log.error("%s", kept.fault)
        elif kept.folder:
            self._tiles.keep_graph(Path(kept.folder))

    def _scan_passed_over(self, message: msg.PassedOver) -> None:
        self._count_left_out(message.sensor, message.age_ns)
        self._put_before(message.log_ns, {"event": "scan_passed_over", "sensor": message.sensor})

    def _count_left_out(self, sensor: str, age_ns: int) -> None:
        now_ns = self._monotonic_ns()
        with self._counting:
            overload = self._overload
            if overload is None or now_ns - overload.last_ns > OVERLOAD_NS:
                overload = _Overload(now_ns)
            oldest_age_ns = max(overload.oldest_age_ns, age_ns)
            self._overload = _Overload(overload.first_ns, now_ns, overload.scans + 1, oldest_age_ns)
            self.passed_over[sensor] += 1

    def _put_before(self, log_ns: int, event: Mapping[str, Any]) -> None:
        """An event among the frames, right before the one of this log time."""
        self._put(encode_event(json.dumps(dict(event)), log_ns - 1, log_ns - 1), None)
