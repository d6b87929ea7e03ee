"""One recording through the mapper, step by step, as the live service took the same steps."""

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivers.counted import counted
from drivers.frames import Frame, LaserScan
from service.encoding import IMU, NO_COVARIANCE, ODOMETRY
from service.errors import InputError
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapper.components import GraphRequestError
from service.mapper.corrections import corrected
from service.mapper.mapping_session import (
    APPLY_AFTER_NS,
    ApplyResult,
    GraphRequest,
    LeftOut,
    LoadMap,
    MappingSession,
    SessionRequest,
    SwitchProfile,
)
from service.mapper.pipeline import Mapper
from service.mapper.profiles import BeginIn, MappingConfig, build_mapper, with_profile
from service.mapper.saved_graph import SavedGraph
from service.mapper.timed import note_mapped
from service.mapstore.begin_in import begin_in
from service.mapstore.patch_files import PatchFiles
from service.offline.replay.figures import (
    ComponentTimes,
    SensorRates,
    StateReasons,
    peak_rss_mb,
    percentiles_ms,
)
from service.offline.replay.pace import Watch
from service.offline.replay.result import Replay
from service.offline.replay.setup import ReplaySetup
from service.outputs import STATES, MapperOutput, TileUpdate
from service.recording.mcap_source import Session
from service.recording.sources import SCAN_TYPES
from service.timing import Timed, Timing
from service.version import VERSION

log = logging.getLogger(__name__)

Progress = Callable[[float | None, str], None]  # share of a phase, None where it is unknown; the phase
MAPPING, CLOSING = "mapping", "closing loops"  # phases
TOO_OLD = "too old to be mapped when live"  # scans with good times, as text for Timing.count_unmapped


class ReplayRun:
    """Maps one recording by `run`, once. The kernels of its profile are compiled by then.

    begin                  the stored map to begin in; None: an empty one
    is_profile_followed    the profile changes where the recording has it so
    compile_kernels        called after each such change
    """

    def __init__(
        self,
        session: Session,
        setup: ReplaySetup,
        begin: BeginIn | None,
        is_profile_followed: bool,
        compile_kernels: Callable[[], object],
        progress: Progress,
        watch: Watch,
    ) -> None:
        self._session = session
        self._recording = session.recording
        self._setup = setup
        self._compile_kernels = compile_kernels
        self._progress = progress
        self._watch = watch
        # Maps to begin in. A reset begins a new map, but for a vehicle that is only localised.
        self._begins = [begin]
        self._switches = ProfileSwitches(setup.mapping, is_profile_followed)
        self._times = ComponentTimes()
        self._mapper = MappingSession(
            self._new_mapper, setup.lasers, apply_after_ns=None if setup.is_as_live else APPLY_AFTER_NS
        )
        self._timing = Timing(setup.lasers, self._mapper.counters, session.topics_of)
        self._left_out: dict[str, LeftOut] = {}  # by sensor: what live happened to its next frame
        self._scan_ns: list[int] = []
        self._scan_cpu_ns: list[int] = []
        self._states: Counter[str] = Counter()
        self._reasons = StateReasons()
        self._rates = SensorRates()
        self._outputs: list[MapperOutput] = []
        self._returns = 0  # beams of the mapped scans that came back
        self._output_lasers: list[str] = []  # whose scan each of them answers
        self._poses: list[SE2] = []  # of the outputs of maps that are finished
        self._tiles: list[TileUpdate] = []  # of the newest finished map, as are the following
        self._g2o, self._keyframes = "", 0
        self._geo: GeoReference | None = None
        self._graph: SavedGraph | None = None

    def run(self) -> Replay:
        """Raises InputError where no scan could be mapped."""
        self._watch.begin(self._session, self._mapper, self._setup.poses_base_sensor)
        began_s = time.monotonic()
        for step in self._session.steps():
            self._watch.wait_for(step.arrived_ns)
            match step:
                case SessionRequest():
                    if step.action == "reset_map":
                        self._finish_map()
                    self._mapper.carry_out(step.action)
                case LoadMap() | SwitchProfile():
                    self._start_over(step)
                case ApplyResult():
                    if self._setup.is_as_live:
                        self._mapper.apply_result()
                case LeftOut():
                    if self._setup.is_as_live:
                        self._left_out[step.sensor] = step
                case GraphRequest():
                    self._request(step)
                case frame:
                    self._rates.add(frame)
                    self._take(frame)
        self._map(self._timing.finish())
        self._progress(1.0, MAPPING)
        self._finish_map()
        self._mapper.close()
        return self._result(time.monotonic() - began_s)

    def _new_mapper(self) -> Mapper[Any]:
        present, begins = self._switches.present, self._begins
        begin = begins[0] if present.mode == "localization" else begins.pop() if begins else None
        return build_mapper(
            present, self._setup.poses_base_sensor, self._times, new_patch_store=PatchFiles, begin_in=begin
        )

    def _start_over(self, step: LoadMap | SwitchProfile) -> None:
        self._finish_map()
        if isinstance(step, LoadMap):
            self._begins[:] = [begin_in(Path(step.folder), self._switches.present, step.version)]
        elif self._switches.take(step, self._recording.first_log_ns):
            self._compile_kernels()
        self._mapper.carry_out("reset_map")

    def _request(self, request: GraphRequest) -> None:
        try:
            self._mapper.request(request.name, request.payload)
        except GraphRequestError as error:
            log.info("%s", error)

    def _take(self, frame: Frame) -> None:
        reason = self._left_out.pop(frame.sensor, None)
        if reason is not None and (reason.reason != "old" or not isinstance(frame, LaserScan)):
            return
        self._map(self._timing.take(frame, is_mapped=reason is None))

    def _map(self, frames: Sequence[Timed]) -> None:
        for frame, is_mapped in frames:
            if is_mapped:
                self._process(frame)
            elif isinstance(frame, LaserScan):
                self._mapper.pass_over(frame)
                self._timing.count_unmapped(frame, TOO_OLD)

    def _process(self, frame: Frame) -> None:
        before_ns, before_cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        output = self._mapper.process(frame)
        if not isinstance(frame, LaserScan):
            return
        note_mapped(self._timing, self._mapper, frame, output)
        if output is None:
            return
        self._scan_cpu_ns.append(time.thread_time_ns() - before_cpu_ns)
        self._scan_ns.append(time.perf_counter_ns() - before_ns)
        self._states[output.state] += 1
        self._reasons.add(output)
        self._outputs.append(output)
        self._returns += int(np.isfinite(frame.range_m).sum())
        self._output_lasers.append(frame.sensor)
        self._watch.mapped(frame, output)
        begin_ns, end_ns = self._recording.first_log_ns, self._recording.last_log_ns
        self._progress((frame.arrived_ns - begin_ns) / max(end_ns - begin_ns, 1), MAPPING)

    def _finish_map(self) -> None:
        """Of a map without a scan there is nothing to show: the one before stays the newest."""
        new = self._outputs[len(self._poses) :]
        if not new:
            return
        self._progress(None, CLOSING)
        self._watch.closing()
        finished = self._mapper.finish()
        self._poses.extend(corrected(new, finished.corrections))
        self._tiles, self._g2o = self._mapper.changed_tiles(), finished.g2o
        self._keyframes = finished.keyframes
        self._geo = self._mapper.geo_reference
        saved = finished.update.saved
        self._graph = saved if isinstance(saved, SavedGraph) else None
        self._watch.finished(self._tiles, self._poses[-len(new) :])

    def _result(self, wall_s: float) -> Replay:
        for warning in self._timing.warnings:
            log.warning("%s", warning)
        if not self._outputs:
            why = "; ".join(self._session.losses) or f"messages read: {dict(self._session.counters)}"
            raise InputError(f"{self._recording.paths[0]}: not one scan could be mapped: {why}")
        if not self._tiles:
            raise InputError(
                f"{self._recording.paths[0]}: nothing to map: {counted(self._returns, 'beam')} came back in "
                f"{counted(len(self._outputs), 'scan')} of {' and '.join(self._setup.lasers)}; of every "
                "other beam the range is NaN, inf, 0 or outside of range_min and range_max; of the last "
                f"scan {self._outputs[-1].reason}"
            )
        for topic, devices in self._session.shared_topics.items():
            log.warning("%s has messages of several frame_ids: %s", topic, _in_words(devices))
        for loss in self._session.losses:
            log.warning("%s", loss)
        for laser, scans in sorted(Counter(self._output_lasers).items()):
            compared = self._mapper.counters[f"scans_compared_{laser}"]
            if 2 * compared > scans:
                log.warning(
                    "%s: %d of %d scans are not in the map: they were compared with that of other lasers, "
                    "until 25 of them agree with its mounting in the config",
                    *(laser, compared, scans),
                )
            if self._mapper.counters[f"mounting_corrected_{laser}"]:
                log.warning(
                    "%s: its scans contradict those of other lasers by more than a calibrated mounting does; "
                    "it was corrected for this drive. `corridor calibrate` measures the mountings",
                    laser,
                )
        # In localisation the map stays the one it was.
        is_localized = self._setup.mapping.mode == "localization"
        return Replay(
            outputs=self._outputs,
            lasers=self._output_lasers,
            poses_base_sensor=self._setup.poses_base_sensor,
            upside_down=self._session.upside_down,
            poses_map_base=self._poses,
            tiles=self._tiles,
            g2o=self._g2o,
            summary=self._summary(wall_s),
            geo=self._geo,
            graph=None if is_localized else self._graph,
            changes=self._mapper.map_changes,
            session=self._graph if is_localized else None,
        )

    def _summary(self, wall_s: float) -> dict[str, Any]:
        counters, outputs, changes = self._mapper.counters, self._outputs, self._mapper.map_changes
        duration_s = (outputs[-1].stamp_ns - outputs[0].stamp_ns) / 1e9
        summary = {
            "corridor": VERSION,
            "profile": self._switches.present.profile,
            "recording": [path.name for path in self._recording.paths],
            "scans": len(outputs),
            "scans_dropped": _dropped(self._session, self._mapper),
            "scans_not_mapped": counters["scans_not_mapped"],
            "scans_passed_over": counters["scans_passed_over"],
            "scans_paused": counters["scans_paused"],
            "scans_before_odometry": counters["scans_before_odometry"],
            "samples_dropped": _samples_dropped(self._session, self._mapper),
            "covariances_ignored": sum(
                self._session.counters[f"{topic} {NO_COVARIANCE}"] for topic in self._session.devices
            ),
            "unmounted": list(self._setup.unmounted),
            "shared_topics": self._session.shared_topics,
            "duration_s": round(duration_s, 3),
            "wall_s": round(wall_s, 3),
            "realtime_factor": round(duration_s / wall_s, 1),
            "scan_ms": percentiles_ms(self._scan_ns),
            "scan_cpu_ms": percentiles_ms(self._scan_cpu_ns),
            "stage_ms_p50": self._times.p50_ms(),
            "loop_closures": counters["loop_closures"],
            "keyframes": self._keyframes,
            "peak_rss_mb": peak_rss_mb(),
            "map_tiles": len(self._tiles),
            "map_resets": counters["map_resets"],
            "state": {state: self._states[state] for state in STATES},
            "state_reasons": self._reasons.as_dict(),
            "fixes": {
                name.removeprefix("fixes_"): count
                for name, count in sorted(counters.items())
                if name.startswith("fixes_")
            },
            "geo_reference": None if self._geo is None else self._geo.as_dict(),
            "sensors": self._rates.as_dict(outputs[0].stamp_ns),
            "mountings": {name: _as_mounting(pose) for name, pose in self._setup.poses_base_sensor.items()},
            "mapping": self._switches.present.model_dump(mode="json"),
        }
        summary |= self._switches.as_dict()
        return summary if changes is None else summary | {"map_changes": changes.as_dict()}


def _as_mounting(pose: SE2) -> dict[str, float]:
    """The pose as a mounting of a config."""
    yaw_deg = math.degrees(pose.theta_rad)
    return {"x_m": round(pose.x_m, 4), "y_m": round(pose.y_m, 4), "yaw_deg": round(yaw_deg, 3)}


def _dropped(session: Session, mapper: MappingSession) -> int:
    """Scans of the mapped lasers that were read and not mapped: out of order, or without anything to map."""
    late = sum(count for name, count in mapper.counters.items() if name.startswith("scans_dropped"))
    scans = [
        topic.name
        for topic in session.recording.topics
        if topic.type in SCAN_TYPES and mapper.lasers & set(session.devices.get(topic.name, {}).values())
    ]
    return late + _unusable(session, scans)


def _samples_dropped(session: Session, mapper: MappingSession) -> dict[str, int]:
    """Samples of odometry and IMUs that were read and not used, by why."""
    why = ("late", "same_stamp", "stamp", "clock", "waiting")
    samples = [topic.name for topic in session.recording.topics if topic.type in (ODOMETRY, IMU)]
    return {
        **{one: mapper.counters[f"samples_dropped_{one}"] for one in why},
        "unusable": _unusable(session, samples),
    }


def _unusable(session: Session, topics: Iterable[str]) -> int:
    return sum(session.counters[f"{topic} unusable"] for topic in topics)


def _in_words(devices: Mapping[str, Mapping[str, Any]]) -> str:
    """Messages of a shared topic as text: "300 of front, read as scan; 299 of rear, refused"."""
    return "; ".join(
        f"{device['messages']} of {frame or 'an empty one'}, "
        + ("refused" if device["sensor"] is None else f"read as {device['sensor']}")
        for frame, device in devices.items()
    )


class ProfileSwitches:
    """How frames are mapped from each switch on; the map begins again at each in any case.

    configured     as the replay begins; a switch back to its profile takes its settings from here
    is_followed    False: --profile names the profile of the replay. One that is only localised in a
                   stored map does not follow either, for no other profile can do that
    """

    def __init__(self, configured: MappingConfig, is_followed: bool) -> None:
        self.present = self._configured = configured
        self._is_followed = is_followed and configured.mode == "mapping"
        self._taken: list[dict[str, Any]] = []

    def take(self, step: SwitchProfile, first_log_ns: int) -> bool:
        """Whether `present` is another one now. Raises InputError where this version has no such profile."""
        at_s = round((step.arrived_ns - first_log_ns) / 1e9, 3)
        if not self._is_followed:
            log.warning(
                "%.3f s after its beginning the recording was mapped on with the profile %s; this replay "
                "stays with %s, and begins a new map there",
                *(at_s, step.profile, self.present.profile),
            )
            return False
        if step.profile == self._configured.profile:
            self.present = self._configured
        else:
            try:
                self.present = with_profile(step.profile, self._configured)
            except ValueError as error:
                raise InputError(
                    f"{at_s:.3f} s after its beginning the recording was mapped on with another profile: "
                    f"{error} Give the profile for the whole replay by --profile"
                ) from error
        self._taken.append({"at_s": at_s, "profile": step.profile})
        log.info(
            "%.3f s after the beginning: mapped on with the profile %s, in a new map", at_s, step.profile
        )
        return True

    def as_dict(self) -> dict[str, Any]:
        """For the summary: nothing where the profile stayed."""
        return {"profile_switches": self._taken} if self._taken else {}
