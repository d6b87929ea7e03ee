"""The mapper: one frame in, at most one MapperOutput out. Read this file first."""

from collections import Counter
from dataclasses import replace
from typing import Generic

from drivers.frames import Frame, GnssFix, ImuSample, LaserScan, OdometrySample
from service.fusion.motion import Motion, Prediction
from service.geometry.geo_reference import GeoReference
from service.mapper.components import (
    Components,
    FinishedGraph,
    Graph,
    GraphUpdate,
    HasPieces,
    KnowsStanding,
    MappedScan,
    Match,
    Placed,
    Points,
    ReadableMap,
    Stopwatch,
)
from service.mapper.judgement import CARRIED_S, drift_of, judge_blank, sigmas_of, too_few
from service.mapper.map_changes import ChangeWatch, MapChanges
from service.mapper.maps.standing import draw_standing
from service.mapper.mounting_check import MountingCheck
from service.mapper.odometry_mounting import OdometryMounting
from service.mapper.place_in_map import PlaceInMap
from service.mapper.saved_graph import KeptGraph, SavedGraph
from service.mapper.scan_check import OdometryWait, ScanCheck
from service.mapper.stamp_check import StampChecks
from service.outputs import NO_REASON, GraphPicture, Grid, MapperOutput, Reason, State, TileUpdate

MOST_BEHIND_NS = 300_000_000  # that a sweep may have begun before the newest pose: latency and a slow laser
CHANGES_TOLD_NS = 5_000_000_000  # between two counts of the cells that have changed
POINT_ARRAYS = ("xy_base", "xy_raw", "beam_time_s", "beam")  # of Points
WELL_NS = 500_000_000  # so long a scan that lay on the map vouches for the place


class NoStopwatch:
    def start(self) -> None: ...
    def lap(self, component: str) -> None: ...


class Mapper(Generic[ReadableMap]):
    """Single-threaded, reads no clock, knows no method by name. Same frames in, same outputs out."""

    def __init__(
        self,
        components: Components[ReadableMap],
        stopwatch: Stopwatch | None = None,
        placed: Placed = "proven",
        is_localizing: bool = False,
        geo_reference: GeoReference | None = None,
        changes: ChangeWatch | None = None,
    ) -> None:
        """placed: "unknown" where the session begins in a stored map, in which the vehicle is to be found.

        is_localizing: the shown map stays as it is. geo_reference: of the stored map. changes: what is to be
        told of how that map has changed; None: nothing is.
        """
        self._changes = changes
        self._changes_told_ns = 0
        self.changes_told: MapChanges | None = None  # as of some seconds ago, see map_changes
        self._components = components
        self._place = PlaceInMap(placed)
        self._is_localizing = is_localizing
        self.saved: SavedGraph | KeptGraph | None = None  # of the newest checkpoint that was asked for
        self.graph_picture: GraphPicture | None = None  # the newest, for people to look at
        self._stopwatch = stopwatch if stopwatch is not None else NoStopwatch()
        self._last_ns: int | None = None  # moment of the newest pose
        self._newest: MapperOutput | None = None
        self._lasers: dict[str, LaserWatch] = {}
        self._sample_ns: dict[type[Frame], int] = {}  # stamp of the last one that was taken, by kind
        self._odometry_wait = OdometryWait()
        self._odometry_mounting = OdometryMounting()
        self._stamps = StampChecks()
        self._travelled_m = 0.0  # as predicted, from scan to scan
        # of the newest scan that was mapped, and its reason
        self._state: tuple[State, Reason] = ("ok", NO_REASON)
        self._placed_ns: int | None = None  # moment of the newest scan with returns; None: that was lost
        self.geo_reference = geo_reference  # None: where the map lies on the earth is not known
        self.counters: Counter[str] = Counter()  # scans, scans_dropped_late, samples_dropped_late ...

    def process(self, frame: Frame) -> MapperOutput | None:
        """Take the next frame in the order of arrival. None for anything but a scan that was mapped.

        A scan that is older than another of its laser is dropped and counted; time never runs backwards. So
        is one that comes right before odometry after a pause of both. Sweeps of several lasers overlap: one
        that began before the newest pose is brought to the moment right after that.
        """
        if isinstance(frame, GnssFix):
            self.counters[self._components.graph.add_fix(frame)] += 1
            return None
        if not isinstance(frame, LaserScan):
            self._take_sample(frame)
            return None
        laser = self._lasers.get(frame.sensor)
        if laser is None:
            laser = self._lasers[frame.sensor] = LaserWatch()
            if len(self._lasers) > 1:
                laser.mounting.begin()
        at_ns = self._moment_of(frame, laser)
        if at_ns is None:
            self.counters["scans_dropped_late"] += 1
            return None
        if self._odometry_wait.waits(at_ns, self._last_ns):
            self.counters["scans_before_odometry"] += 1
            return None
        laser.stamp_ns, self._last_ns = frame.stamp_ns, at_ns
        self.counters["scans"] += 1
        return self._process_scan(frame, at_ns, laser)

    def _take_sample(self, sample: ImuSample | OdometrySample) -> None:
        kind = type(sample)
        if not self._components.motion_model.add(sample):
            is_same = sample.stamp_ns == self._sample_ns.get(kind)
            self.counters["samples_dropped_same_stamp" if is_same else "samples_dropped_late"] += 1
            return
        self._sample_ns[kind] = sample.stamp_ns
        if isinstance(sample, OdometrySample):
            self._odometry_wait.add(sample.stamp_ns)
            self._odometry_mounting.add_odometry(sample)

    def skip(self, scan: LaserScan) -> None:
        """Let a scan pass unmapped: the base is where wheels and gyro say it is, or stands without them.

        Dead reckoning goes from scan to scan, for the motion model forgets samples after a while.
        """
        at_ns = self._components.deskew.moment_of(scan)
        if self._last_ns is None or at_ns <= self._last_ns:
            return
        self._last_ns = at_ns
        self._predict(at_ns)
        self._components.motion_model.correct(None)

    def _moment_of(self, scan: LaserScan, laser: "LaserWatch") -> int | None:
        """To which moment its points are brought, ns; None: it is too old."""
        if laser.stamp_ns is not None and scan.stamp_ns <= laser.stamp_ns:
            return None
        at_ns = self._components.deskew.moment_of(scan)
        if self._last_ns is None or at_ns > self._last_ns:
            return at_ns
        return self._last_ns + 1 if self._last_ns - at_ns <= MOST_BEHIND_NS else None

    def changed_tiles(self, most: int | None = None) -> list[TileUpdate]:
        """Tiles of the shown map that changed since the last call; at most so many."""
        return self._components.free_space.changed_tiles(most)

    def tiles(self) -> list[TileUpdate]:
        """All tiles of the shown map as they are now, for who only looks on."""
        return self._components.free_space.tiles()

    def standing(self) -> Grid | None:
        """How long things stand around the vehicle, as draw_standing has it, for who only looks on; None
        where that is not counted or nothing is mapped yet.
        """
        local_map = self._components.local_map
        if self._newest is None or not isinstance(local_map, KnowsStanding):
            return None
        standing = local_map.standing()
        return None if standing is None else draw_standing(standing, self._newest)

    @property
    def pose_refused(self) -> tuple[float, float, float] | None:
        """As PlaceInMap.pose_refused."""
        return self._place.pose_refused

    @property
    def graph(self) -> Graph:
        """To be asked and told; what comes back goes through apply_result and finish of the mapper."""
        return self._components.graph

    def apply_result(self) -> None:
        """Bring in the oldest piece of work of the graph, between two frames; waits for it."""
        update = self._components.graph.apply_result()
        if update is not None:
            self._bring_in(update)

    @property
    def map_changes(self) -> MapChanges | None:
        """What has changed since the map was stored; None: nobody watches."""
        return None if self._changes is None else self._changes.changes()

    def finish(self) -> FinishedGraph:
        """The graph's last word, after the last frame; the shown map is corrected, too."""
        finished = self._components.graph.finish()
        self._bring_in(finished.update)
        return finished

    def _bring_in(self, update: GraphUpdate) -> None:
        self.counters.update(update.counts)
        if update.geo is not None:
            self.geo_reference = update.geo
        self._place.take(update)
        if update.saved is not None:
            self.saved = update.saved
        if update.picture is not None:
            self.graph_picture = update.picture
        if update.joined is not None:
            self._components.local_map.join(update.joined)
        if self._components.graph.fault:
            self._place.graph_ended()
            if isinstance(self._components.local_map, HasPieces):
                self._components.local_map.attach()
        if update.rendered_map is not None:
            self._components.free_space.replace_by(update.rendered_map, update.since)

    def _predict(self, stamp_ns: int) -> Prediction:
        predicted = self._components.motion_model.predict(stamp_ns)
        if predicted.samples_dropped:
            self.counters["samples_dropped_waiting"] += predicted.samples_dropped
        return predicted

    def _process_scan(self, scan: LaserScan, at_ns: int, laser: "LaserWatch") -> MapperOutput:
        s, watch = self._components, self._stopwatch
        watch.start()
        if self._newest is None and scan.stamp_ns < at_ns:
            s.motion_model.begin_at(scan.stamp_ns)
        predicted = self._predict(at_ns)  # where we should be, and how fast
        self._travelled_m += predicted.travel_m
        moved_m, laser.travelled_m = self._travelled_m - laser.travelled_m, self._travelled_m
        if laser.check.is_repeated(scan, moved_m):
            return self._passed_over(scan, at_ns)
        points = s.deskew(scan, predicted, at_ns)  # base frame, one instant; keeps each beam's time
        watch.lap("deskew")
        is_doubted = not laser.mounting.is_right or self._stamps.fault_of(scan.sensor)
        if laser.mounting.fault or (is_doubted and self._well_besides(scan.sensor, at_ns)):
            return self._compared(scan, at_ns, laser, points, predicted)
        if predicted.pause_s > CARRIED_S and s.graph.finds_pieces and isinstance(s.local_map, HasPieces):
            s.local_map.detach(predicted.pause_s)
        match = s.matcher.match(points, predicted, s.local_map)  # where we are
        match = replace(match, motion=s.motion_model.correct(match.measured))
        watch.lap("match")
        few = too_few(match.points)
        if match.state == "lost":
            self._odometry_mounting.interrupt()
            self._stamps.interrupt()
        if match.state == "lost" and (well := self._well_besides(scan.sensor, at_ns)):
            return self._contradicted(scan, at_ns, match, well, few)
        if not few:  # else it says nothing of the place, for or against
            laser.well_ns = at_ns if match.state != "lost" else None
        if match.state == "ok":
            self._stamps.add(scan.sensor, at_ns, match.motion.pose_odom_base.theta_rad)
        if match.state == "ok" and (fault := self._motion_fault(match, at_ns)):
            match = replace(match, state="degraded", reason=fault)
        change = s.local_map.insert(match.points, match)
        still = _still(match)
        self.counters["keyframes"] += change.is_keyframe
        if change.is_keyframe:
            s.motion_model.settle(change.error_left)
        covariance = predicted.local_covariance if match.measured is None else match.measured.covariance
        pose_map_odom = s.graph.add(
            MappedScan(at_ns, still, match, change, covariance, predicted.elapsed_s, predicted.pause_s)
        )
        is_drawn = match.state != "lost" and self._place.is_found and not self._is_localizing
        match = self._place.judged(match, change, pose_map_odom)
        if few:
            match = self._blank(match, few, at_ns, predicted)
        else:
            self._placed_ns = at_ns if match.state != "lost" else None
        if is_drawn:  # nothing is where nobody knows the place
            s.free_space.insert(still, pose_map_odom @ match.motion.pose_odom_base)
        if match.state == "ok" and self._place.is_proven and self._changes is not None:
            self._changes.add(still, pose_map_odom @ match.motion.pose_odom_base, at_ns)
            self._tell_changes(self._changes, at_ns)
        watch.lap("insert")
        self._state = match.state, match.reason
        return self._output(scan, at_ns, match.motion, match.state, match.reason, match.inlier_ratio)

    def _blank(self, match: Match, few: Reason, at_ns: int, predicted: Prediction) -> Match:
        """A scan with too few returns, by any matcher lost, with the state that the prediction deserves."""
        self.counters[f"scans_blind_{match.points.scan.sensor}"] += 1
        if self._placed_ns is None:
            return match
        sigmas = sigmas_of(predicted.local_covariance)
        state, reason = judge_blank(few, sigmas, (at_ns - self._placed_ns) * 1e-9)
        return replace(match, state=state, reason=reason)

    def _motion_fault(self, match: Match, at_ns: int) -> Reason:
        """What contradicts a scan that lay on the map: by odometry, the mounting; or a source of motion."""
        self._odometry_mounting.add_pose(at_ns, match.motion.pose_odom_base)
        return self._odometry_mounting.fault or self._components.motion_model.fault

    def _tell_changes(self, changes: ChangeWatch, at_ns: int) -> None:
        if at_ns - self._changes_told_ns < CHANGES_TOLD_NS:
            return
        self._changes_told_ns = at_ns
        self.changes_told = changes.changes()
        is_new = self.changes_told.is_new
        self.counters["changed_cells_new"] = int(is_new.sum())
        self.counters["changed_cells_gone"] = int((~is_new).sum())

    def _compared(
        self, scan: LaserScan, at_ns: int, laser: "LaserWatch", points: Points, predicted: Prediction
    ) -> MapperOutput:
        """A scan of a laser with mounting or stamps in doubt: aligned with the map, with no say in it."""
        self.counters[f"scans_compared_{scan.sensor}"] += 1
        looked_for = laser.mounting.where_to_look(predicted, self._stamps.late_s(scan.sensor))
        match = self._components.matcher.match(points, looked_for, self._components.local_map)
        if match.measured is not None and match.state != "lost":
            self._stamps.add(scan.sensor, at_ns, match.measured.pose_odom_base.theta_rad)
            laser.mounting.add(looked_for, match.measured)
        elif match.is_contradicted:
            laser.mounting.miss()
        motion = self._components.motion_model.correct(None)
        state, reason = self._state
        if fault := self._stamps.fault_of(scan.sensor) or laser.mounting.fault:
            is_alone = not self._well_besides(scan.sensor, at_ns)
            if is_alone or state == "ok":
                state, reason = "lost" if is_alone else "degraded", fault.reworded(f"{scan.sensor} {fault}")
        return self._output(scan, at_ns, motion, state, reason, match.inlier_ratio)

    def _well_besides(self, sensor: str, at_ns: int) -> str:
        """Another laser whose scans lay on the map just now; "" where there is none."""
        well = [
            name
            for name, laser in self._lasers.items()
            if name != sensor and laser.well_ns is not None and at_ns - laser.well_ns <= WELL_NS
        ]
        return min(well, default="")

    def _contradicted(self, scan: LaserScan, at_ns: int, match: Match, well: str, few: str) -> MapperOutput:
        """A scan that fits nowhere while those of another laser do: its laser is wrong, not the place.

        One of hardly a return contradicts nothing: its laser is covered, or nothing is in its range.
        """
        if few:
            self.counters[f"scans_blind_{scan.sensor}"] += 1
            reason = Reason("laser_covered", f"{few} It is not mapped; {well} confirms the map")
            return self._output(scan, at_ns, match.motion, "degraded", reason, match.inlier_ratio)
        self.counters[f"scans_contradicting_{scan.sensor}"] += 1
        reason = Reason(
            "laser_contradicts",
            f"{scan.sensor} contradicts the map that {well} confirms ({match.reason}); its scan is not "
            "mapped. Is its mounting as configured, is its window clean?",
        )
        return self._output(scan, at_ns, match.motion, "degraded", reason, match.inlier_ratio)

    def _passed_over(self, scan: LaserScan, at_ns: int) -> MapperOutput:
        """A scan that equals the one before: the pose follows the prediction, and nothing is mapped."""
        self.counters["scans_repeated"] += 1
        motion = self._components.motion_model.correct(None)
        reason = Reason(
            "laser_repeats",
            f"{scan.sensor}: identical scans although the vehicle moves; has the laser stopped measuring?",
        )
        state: State = "degraded" if self._well_besides(scan.sensor, at_ns) else "lost"
        return self._output(scan, at_ns, motion, state, reason, 0.0)

    def _output(
        self, scan: LaserScan, at_ns: int, motion: Motion, state: State, reason: Reason, share: float
    ) -> MapperOutput:
        """Where the base was when the scan began; right after the output before, where it began sooner.

        at_ns   moment of the motion
        """
        stamp_ns = scan.stamp_ns
        if self._newest is not None:
            stamp_ns = max(stamp_ns, self._newest.stamp_ns + 1)
        if stamp_ns != at_ns:
            motion = self._components.motion_model.moved((stamp_ns - at_ns) * 1e-9)
        covariance = self._place.covariance_of(motion)
        if state == "ok" and (drift := drift_of(covariance)):
            state, reason = "degraded", drift
        self._newest = MapperOutput(
            stamp_ns=stamp_ns,
            pose_odom_base=motion.pose_odom_base,
            pose_map_odom=self._place.pose_map_odom,
            twist_base=motion.twist_base,
            covariance=covariance,
            state=state,
            reason=reason,
            inlier_ratio=share,
            geo_reference=self.geo_reference,
            odom_covariance=motion.covariance,
        )
        return self._newest


class LaserWatch:
    """What is remembered of one laser."""

    def __init__(self) -> None:
        self.check = ScanCheck()
        self.mounting = MountingCheck()
        self.stamp_ns: int | None = None  # of its newest scan
        self.well_ns: int | None = None  # moment of its newest scan, if that lay on the map
        self.travelled_m = 0.0  # of the mapper, up to that scan


def _still(match: Match) -> Points:
    """The points of what does not move."""
    if match.is_moving is None:
        return match.points
    kept = {name: getattr(match.points, name)[~match.is_moving] for name in POINT_ARRAYS}
    return replace(match.points, **kept)
