"""The mapper: one frame in, at most one MapperOutput out. Read this file first."""

from collections import Counter
from typing import Generic

import numpy as np
import numpy.typing as npt

from drivers.frames import Frame, GnssFix, ImuSample, LaserScan, OdometrySample
from service.estimator.motion import Motion, Prediction
from service.geometry.geo_reference import GeoReference
from service.mapper.checks.sensor_checks import SensorChecks, Verdict
from service.mapper.components import (
    Components,
    CountsStanding,
    Detachable,
    EditAnswer,
    FinishedGraph,
    Graph,
    GraphUpdate,
    MappedScan,
    Match,
    Placed,
    Points,
    ReadableMap,
    Stopwatch,
)
from service.mapper.judgement import drift_of, is_motion_unmeasured, of_laser, of_standstill, too_few
from service.mapper.localisation import Localisation, SegmentMotion
from service.mapper.map_changes import ChangeWatch, MapChanges
from service.mapper.maps.occupancy import draw_standing
from service.mapper.saved_graph import KeptGraph, SavedGraph
from service.outputs import NO_REASON, GraphPicture, Grid, MapperOutput, Reason, TileUpdate

MAX_BEHIND_NS = 300_000_000  # of a sweep's start before the newest pose: latency and a slow laser
CHANGES_REPORTED_NS = 5_000_000_000  # between two counts of the changed cells
POINT_ARRAYS = ("xy_base", "xy_raw", "beam_time_s", "beam")  # of Points


class Mapper(Generic[ReadableMap]):
    """Single-threaded, reads no clock, independent of the method. The same frames give the same outputs."""

    def __init__(
        self,
        components: Components[ReadableMap],
        stopwatch: Stopwatch | None = None,
        placed: Placed = "proven",
        is_localizing: bool = False,
        geo_reference: GeoReference | None = None,
        changes: ChangeWatch | None = None,
    ) -> None:
        """placed: "unknown" if the session begins in a stored map, in which the vehicle is to be localised.

        is_localizing: the shown map stays as it is. geo_reference: of the stored map. changes: detects
        changes of that map; None: off.
        """
        self._changes = changes
        self._changes_reported_ns = 0
        self.changes_reported: MapChanges | None = None  # as of some seconds ago, see map_changes
        self.components = components
        self._localisation = Localisation(placed)
        self.is_localizing = is_localizing
        self.saved: SavedGraph | KeptGraph | None = None  # graph of the newest checkpoint
        self.graph_picture: GraphPicture | None = None  # the newest, for display
        self.edited: list[EditAnswer] = []  # in the order of the requests; taken by the caller
        self._stopwatch = stopwatch or Stopwatch()
        self._last_ns: int | None = None  # moment of the newest pose
        self._newest: MapperOutput | None = None
        self._scan_ns: dict[str, int] = {}  # stamp of the newest one, by laser
        self._sample_ns: dict[type[Frame], int] = {}  # stamp of the newest accepted one, by type
        self._state = Verdict("ok", NO_REASON)  # of the newest mapped scan
        self._segment_motion = SegmentMotion()
        self._unmatched: Prediction | None = None  # the newest; None: its scan was matched
        self.geo_reference = geo_reference  # None: not known
        self.counters: Counter[str] = Counter()  # scans, scans_dropped_late, samples_dropped_late ...
        self._checks = SensorChecks(self.counters)

    def process(self, frame: Frame) -> MapperOutput | None:
        """Process the next frame in order of arrival. Returns None for anything but a mapped scan.

        A scan older than another of its laser is dropped and counted, and so is one that arrives right before
        odometry after a pause of both. Sweeps of several lasers overlap: the points of one that began before
        the newest pose are deskewed to the moment right after that pose.
        """
        if isinstance(frame, GnssFix):
            self.counters[self.components.graph.add_fix(frame)] += 1
            return None
        if not isinstance(frame, LaserScan):
            self._take_sample(frame)
            return None
        at_ns = self._moment_of(frame)
        if at_ns is None:
            self.counters["scans_dropped_late"] += 1
            return None
        if self._checks.odometry_wait.waits(at_ns, self._last_ns):
            self.counters["scans_before_odometry"] += 1
            return None
        self._scan_ns[frame.sensor], self._last_ns = frame.stamp_ns, at_ns
        self.counters["scans"] += 1
        return self._process_scan(frame, at_ns)

    def _take_sample(self, sample: ImuSample | OdometrySample) -> None:
        kind = type(sample)
        if not self.components.motion_model.add(sample):
            is_same = sample.stamp_ns == self._sample_ns.get(kind)
            self.counters["samples_dropped_same_stamp" if is_same else "samples_dropped_late"] += 1
            return
        self._sample_ns[kind] = sample.stamp_ns
        if isinstance(sample, OdometrySample):
            self._checks.add_odometry(sample)

    def skip(self, scan: LaserScan) -> None:
        """Let a scan pass unmapped: the pose follows wheels and gyro, or stays without them.

        Dead reckoning proceeds from scan to scan, since the motion model keeps samples for a limited time.
        """
        at_ns = self.components.deskew.moment_of(scan)
        if self._last_ns is None or at_ns <= self._last_ns:
            return
        self._last_ns = at_ns
        self._predict(at_ns)
        self.components.motion_model.correct(None)

    def _moment_of(self, scan: LaserScan) -> int | None:
        """Moment to which the scan's points are deskewed, ns; None: the scan is too old."""
        if scan.stamp_ns <= self._scan_ns.get(scan.sensor, scan.stamp_ns - 1):
            return None
        at_ns = self.components.deskew.moment_of(scan)
        if self._last_ns is None or at_ns > self._last_ns:
            return at_ns
        return self._last_ns + 1 if self._last_ns - at_ns <= MAX_BEHIND_NS else None

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        """Tiles of the shown map changed since the last call, at most `most`."""
        return self.components.free_space.changed_tiles(most)

    def tiles(self) -> list[TileUpdate]:
        """All tiles of the shown map; does not affect changed_tiles."""
        return self.components.free_space.tiles()

    def standing(self) -> Grid | None:
        """Durations of occupied cells around the vehicle, by draw_standing; None without such counts or a
        scan.
        """
        local_map = self.components.local_map
        if self._newest is None or not isinstance(local_map, CountsStanding):
            return None
        standing = local_map.standing()
        return None if standing is None else draw_standing(standing, self._newest)

    @property
    def pose_refused(self) -> tuple[float, float, float] | None:
        """m, m, rad: pose set by the operator that the scans contradict; None: none."""
        return self._localisation.place.pose_refused

    @property
    def graph(self) -> Graph:
        """For requests and queries; its results are applied by apply_result and finish of the mapper."""
        return self.components.graph

    def apply_result(self) -> None:
        """Apply the oldest result of the graph, between two frames; waits for it."""
        update = self.components.graph.apply_result()
        if update is not None:
            self._bring_in(update)

    @property
    def map_changes(self) -> MapChanges | None:
        """Changes since the map was stored; None: not monitored."""
        return None if self._changes is None else self._changes.changes()

    def finish(self) -> FinishedGraph:
        """Final result of the graph, after the last frame; the shown map is corrected as well."""
        finished = self.components.graph.finish()
        self._bring_in(finished.update)
        return finished

    def _bring_in(self, update: GraphUpdate) -> None:
        self.counters.update(update.counts)
        if update.geo is not None:
            self.geo_reference = update.geo
        self._localisation.take(update)
        if update.saved is not None:
            self.saved = update.saved
        if update.picture is not None:
            self.graph_picture = update.picture
        if update.edited is not None:
            self.edited.append(update.edited)
        if update.is_localizing is not None:
            self.is_localizing = update.is_localizing
        if update.joined is not None:
            self.components.local_map.join(update.joined)
        if self.components.graph.fault:
            self._localisation.graph_ended()
            if isinstance(self.components.local_map, Detachable):
                self.components.local_map.attach()
        if update.rendered_map is not None:
            self.components.free_space.replace_by(update.rendered_map, update.since)

    def _predict(self, stamp_ns: int) -> tuple[float, Prediction]:
        """Travel since the newest prediction, m, and the prediction since the last scan that was matched."""
        newest = self.components.motion_model.predict(stamp_ns)
        if newest.samples_dropped:
            self.counters["samples_dropped_waiting"] += newest.samples_dropped
        self._unmatched = newest if self._unmatched is None else newest.after(self._unmatched)
        return newest.travel_m, self._unmatched

    def _process_scan(self, scan: LaserScan, at_ns: int) -> MapperOutput:
        s, watch = self.components, self._stopwatch
        watch.start()
        if self._newest is None and scan.stamp_ns < at_ns:
            s.motion_model.begin_at(scan.stamp_ns)
        travel_m, predicted = self._predict(at_ns)  # pose and twist
        if refused := self._checks.refuse(scan, at_ns, travel_m):
            return self._output(scan, at_ns, s.motion_model.correct(None), refused, 0.0)
        # base frame, one instant; keeps each beam's time
        points = s.deskew(scan, predicted, at_ns, self._checks.lasers[scan.sensor].mounting.applied)
        watch.lap("deskew")
        prior = self._checks.comparison_prior(scan.sensor, at_ns, predicted)
        if prior is not None:
            return self._compared(points, at_ns, prior)
        predicted, segment_s = self._segment_motion.predicted(at_ns, predicted)
        is_paused = is_motion_unmeasured(predicted)
        is_unmeasured = is_paused or segment_s > 0.0
        if is_unmeasured and s.graph.finds_segments and isinstance(s.local_map, Detachable):
            s.local_map.detach(max(predicted.pause_s, segment_s))
        match = s.matcher.match(points, predicted, s.local_map)  # pose against the map
        few = too_few(points)
        if not few:
            self._unmatched = None
        reason = match.reason and of_laser(scan.sensor, match.reason)
        if predicted.is_standing:
            reason = of_standstill(reason)
        match = match._replace(motion=s.motion_model.correct(match.measured), reason=reason)
        watch.lap("match")
        checked = self._checks.judge(match, few, predicted, at_ns, s.motion_model.fault)
        if isinstance(checked, Verdict):
            return self._output(scan, at_ns, match.motion, checked, match.inlier_ratio)
        self._segment_motion.matched(at_ns, predicted, is_paused, checked.state != "lost")
        match = self._insert(checked, few, at_ns, predicted, is_unmeasured)
        watch.lap("insert")
        self._state = Verdict(match.state, match.reason)
        return self._output(scan, at_ns, match.motion, self._state, match.inlier_ratio)

    def _insert(
        self, match: Match, few: Reason, at_ns: int, predicted: Prediction, is_unmeasured: bool
    ) -> Match:
        """Insert a match into local map, graph and shown map; sets its state by its place in the map."""
        s = self.components
        change = s.local_map.insert(match.points, match)
        static = match.points if match.is_moving is None else _static_points(match.points, ~match.is_moving)
        self.counters["keyframes"] += change.is_keyframe
        if change.is_keyframe:
            s.motion_model.settle(change.error_left)
        prior = predicted.local_covariance
        covariance = prior if match.measured is None else match.measured.covariance
        elapsed_s = predicted.elapsed_s
        pose_map_odom = s.graph.add(
            MappedScan(at_ns, static, match, change, covariance, elapsed_s, is_unmeasured)
        )
        placed = self._localisation.place.placed
        is_shown = match.state != "lost" and placed != "unknown" and not self.is_localizing
        match = self._localisation.judged(match, few, change, pose_map_odom, at_ns, prior)
        if is_shown:  # not while the place in the map is unknown
            s.free_space.insert(static, pose_map_odom @ match.motion.pose_odom_base)
        if match.state == "ok" and placed == "proven" and self._changes is not None:
            self._changes.add(static, pose_map_odom @ match.motion.pose_odom_base, at_ns)
            self._report_changes(self._changes, at_ns)
        return match

    def _report_changes(self, changes: ChangeWatch, at_ns: int) -> None:
        if at_ns - self._changes_reported_ns < CHANGES_REPORTED_NS:
            return
        self._changes_reported_ns = at_ns
        self.changes_reported = changes.changes()
        is_new = self.changes_reported.is_new
        self.counters["changed_cells_new"] = int(is_new.sum())
        self.counters["changed_cells_gone"] = int((~is_new).sum())

    def _compared(self, points: Points, at_ns: int, prior: Prediction) -> MapperOutput:
        """Output for a scan of a laser under test: aligned with the map, without effect on pose and map."""
        match = self.components.matcher.compare(points, prior, self.components.local_map)
        motion = self.components.motion_model.correct(None)
        state = self._checks.compare(match, at_ns, prior, self._state)
        return self._output(points.scan, at_ns, motion, state, match.inlier_ratio)

    def _output(
        self, scan: LaserScan, at_ns: int, motion: Motion, state: Verdict, share: float
    ) -> MapperOutput:
        """Output at the scan's stamp, or right after the output before if the scan began earlier.

        at_ns   moment of the motion
        """
        stamp_ns = scan.stamp_ns
        if self._newest is not None:
            stamp_ns = max(stamp_ns, self._newest.stamp_ns + 1)
        if stamp_ns != at_ns:
            motion = self.components.motion_model.moved((stamp_ns - at_ns) * 1e-9)
        covariance = self._localisation.covariance_of(motion)
        if state.state == "ok" and (drift := drift_of(covariance)):
            state = Verdict("degraded", drift)
        self._newest = MapperOutput(
            stamp_ns=stamp_ns,
            pose_odom_base=motion.pose_odom_base,
            pose_map_odom=self._localisation.pose_map_odom,
            twist_base=motion.twist_base,
            covariance=covariance,
            state=state.state,
            reason=state.reason,
            inlier_ratio=share,
            geo_reference=self.geo_reference,
            odom_covariance=motion.covariance,
        )
        return self._newest


def _static_points(points: Points, is_static: npt.NDArray[np.bool_]) -> Points:
    return points._replace(**{name: getattr(points, name)[is_static] for name in POINT_ARRAYS})
