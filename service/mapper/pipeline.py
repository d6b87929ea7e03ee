"""The mapper: one frame in, at most one MapperOutput out. Read this file first."""

from collections import Counter
from dataclasses import replace
from typing import Generic

from drivers.frames import Frame, GnssFix, LaserScan
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapper.scan_check import ScanCheck
from service.mapper.stages import (
    FinishedGraph,
    Graph,
    GraphUpdate,
    MappedScan,
    ReadableMap,
    Stages,
    Stopwatch,
)
from service.outputs import MapperOutput, TileUpdate


class NoStopwatch:
    def start(self) -> None: ...
    def lap(self, stage: str) -> None: ...


class Mapper(Generic[ReadableMap]):
    """Single-threaded, reads no clock, knows no method by name. Same frames in, same outputs out."""

    def __init__(self, stages: Stages[ReadableMap], stopwatch: Stopwatch | None = None) -> None:
        self._stages = stages
        self._stopwatch = stopwatch if stopwatch is not None else NoStopwatch()
        self._last_stamp_ns: int | None = None
        self._check = ScanCheck()
        self._pose_map_odom = SE2()
        self.geo_reference: GeoReference | None = None  # None: where the map lies on the earth is not known
        self.counters: Counter[str] = Counter()  # scans, scans_dropped_late, samples_dropped_late ...

    def process(self, frame: Frame) -> MapperOutput | None:
        """Take the next frame in the order of arrival. None for anything but a scan that was mapped.

        A scan that is older than one already mapped is dropped and counted; time never runs backwards. So is
        one whose stamp is seconds off those around it.
        """
        if isinstance(frame, GnssFix):
            self.counters[self._stages.graph.add_fix(frame)] += 1
            return None
        if not isinstance(frame, LaserScan):
            if not self._stages.motion_model.add(frame):
                self.counters["samples_dropped_late"] += 1
            return None
        if self._check.refuses(frame):
            self.counters["scans_dropped_stamp"] += 1
            return None
        if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
            self.counters["scans_dropped_late"] += 1
            return None
        self._last_stamp_ns = frame.stamp_ns
        self.counters["scans"] += 1
        return self._process_scan(frame)

    def skip(self, scan: LaserScan) -> None:
        """Let a scan pass unmapped: the base is where wheels and gyro say it is, or stands without them.

        Dead reckoning goes from scan to scan, for the motion model forgets samples after a while.
        """
        if self._last_stamp_ns is None or scan.stamp_ns <= self._last_stamp_ns:
            return
        self._last_stamp_ns = scan.stamp_ns
        self._stages.motion_model.predict(scan.stamp_ns)
        self._stages.motion_model.correct(None)

    def changed_tiles(self) -> list[TileUpdate]:
        """Tiles of the shown map that changed since the last call."""
        return self._stages.free_space.changed_tiles()

    @property
    def graph(self) -> Graph:
        """To be asked and told; what comes back goes through take_in and finish of the mapper."""
        return self._stages.graph

    def take_in(self) -> None:
        """Bring in the oldest piece of work of the graph, between two frames; waits for it."""
        self._bring_in(self._stages.graph.take_in())

    def finish(self) -> FinishedGraph:
        """The graph's last word, after the last frame; the shown map is corrected, too."""
        finished = self._stages.graph.finish()
        self._bring_in(finished.update)
        return finished

    def _bring_in(self, update: GraphUpdate) -> None:
        self.counters.update(update.counts)
        if update.geo is not None:
            self.geo_reference = update.geo
        if update.joined:
            self._stages.local_map.join(update.joined)
        if update.sheet is not None:
            self._stages.free_space.lay(update.sheet, update.since)

    def _process_scan(self, scan: LaserScan) -> MapperOutput:
        s, watch = self._stages, self._stopwatch
        watch.start()
        predicted = s.motion_model.predict(scan.stamp_ns)  # where we should be, and how fast
        if self._check.is_repeated(scan, predicted.travel_m):
            return self._passed_over(scan)
        points = s.deskew(scan, predicted)  # base frame, one instant; keeps each beam's time
        watch.lap("deskew")
        match = s.matcher.match(points, predicted, s.local_map)  # where we are
        match = replace(match, motion=s.motion_model.correct(match.measured))
        if match.state == "ok" and (fault := s.motion_model.fault):
            match = replace(match, state="degraded", reason=fault)
        watch.lap("match")
        kept = s.keep_static(match.points, match)
        change = s.local_map.insert(kept, match)
        self.counters["keyframes"] += change.is_keyframe
        if change.is_keyframe:
            s.motion_model.settle(change.error_left)
        covariance = predicted.local_covariance if match.measured is None else match.measured.covariance
        pose_map_odom = self._pose_map_odom = s.graph.add(
            MappedScan(scan.stamp_ns, kept, match, change, covariance, predicted.elapsed_s)
        )
        if match.state != "lost":  # nothing is drawn from a place that nobody knows
            s.free_space.insert(kept, pose_map_odom @ match.motion.pose_odom_base)
        watch.lap("insert")
        return MapperOutput(
            stamp_ns=scan.stamp_ns,
            pose_odom_base=match.motion.pose_odom_base,
            pose_map_odom=pose_map_odom,
            twist_base=match.motion.twist_base,
            covariance=match.motion.covariance,
            state=match.state,
            reason=match.reason,
            match_share=match.inlier_ratio,
            geo_reference=self.geo_reference,
        )

    def _passed_over(self, scan: LaserScan) -> MapperOutput:
        """A scan that says nothing: the pose follows the prediction, and nothing is mapped."""
        self.counters["scans_repeated"] += 1
        motion = self._stages.motion_model.correct(None)
        return MapperOutput(
            stamp_ns=scan.stamp_ns,
            pose_odom_base=motion.pose_odom_base,
            pose_map_odom=self._pose_map_odom,
            twist_base=motion.twist_base,
            covariance=motion.covariance,
            state="lost",
            reason=f"{scan.sensor}: the same scan comes again though the vehicle moves; does the laser hang?",
            match_share=0.0,
            geo_reference=self.geo_reference,
        )
