"""The live service: builds everything from the config, starts it, watches over it, ends it in good order.

    reader threads --frames--> Intake --messages--> Sinks: network, recording, stored map ...
    (one a device)               |                    ^ messages, changed tiles
                            MapperLink --items--> mapper's process --poses, tiles--> MappingOutputs

Which sinks there are is known to service/sinks/registry.py alone. The main thread calls `start`, then `tick`
several times a second, at last `stop`.
"""

import gc
import json
import logging
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

from drivers.frames import Frame
from drivers.link import LinkHealth
from service.config import ServiceConfig, mapped_lasers, mounted_upside_down, mountings, tf_static
from service.deadline import WORKING_S, Deadline
from service.encoding import decode_pose, encode_event
from service.encoding import warm_up as warm_up_encoding
from service.errors import CorridorError, InputError
from service.geometry.se2 import SE2
from service.mapper.profiles import begins_in_stored
from service.mapstore.begin_in import MapVersion, stored_for, version_to_begin_in
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.publishing.commands import Answer, CommandDispatcher, CommandError
from service.runtime.commands import Commands
from service.runtime.early_mapper import EarlyMapper
from service.runtime.health import HealthReport
from service.runtime.host_time import HostTime
from service.runtime.intake import Intake
from service.runtime.mapper_link import MapperLink
from service.runtime.mapper_messages import Setup
from service.runtime.mapping_outputs import MappingOutputs
from service.runtime.metrics import LatencyHistogram
from service.runtime.notify import Notifier
from service.runtime.profile_switch import PresentMapping, ProfileSwitch
from service.runtime.readers import Readers, Workers
from service.runtime.resume import Point, PointWriter, point_file, resumed
from service.runtime.summary import RunningStatus, Summary, running_status
from service.sinks.fan_out import Sinks
from service.sinks.registry import SINKS
from service.sinks.sink import SinkContext
from service.version import VERSION

log = logging.getLogger(__name__)

HEALTH_INTERVAL_NS = 1_000_000_000
WARM_UP_ASK_S = 5.0  # how often systemd is notified that kernels are still being compiled
WARM_UP_MORE_S = 60.0  # and how long it may take from then on
WARM_UP_TELL_S = 2.0  # how often the log reports that it goes on
GRAPH_FINISH_S = 20.0  # for the last loops, at the end of a run
WAKE_S = 0.1  # how often a start looks whether it is cancelled


class Service:
    """One vehicle's service, of one life: start, tick, stop. The sinks are open as soon as it is constructed.

    map_folder    where this run's map goes; left out, a folder named by vehicle and time in map.directory
    on_failure    called from any thread when `failure` gets its text

    Raises InputError where the stored map to begin in cannot be read, StorageError where a sink cannot be
    opened.
    """

    def __init__(
        self,
        config: ServiceConfig,
        notifier: Notifier,
        map_folder: Path | None = None,
        on_failure: Callable[[], None] = lambda: None,
        early: EarlyMapper | None = None,
    ) -> None:
        config, self._resume_pose = resumed(config)
        self._config = config
        self._begun_in = _begun_in(config)  # refused here, before anything runs
        self._notifier = notifier
        self.host_time = HostTime.now()
        self._workers = Workers(on_failure)
        self._excepthook = threading.excepthook
        self._mapping: threading.Thread | None = None
        self._tiles = TileStore()
        self._latency = LatencyHistogram()
        links = {name: LinkHealth(name) for name in config.sensors}
        self._present = PresentMapping(config.mapping)
        self._sinks = Sinks()
        self._sinks.open(SINKS, config.sinks, self._sink_context(links, map_folder))
        put = self._sinks.put
        self.outputs = MappingOutputs(
            mapped_lasers(config), self._tiles, put, self._put_tiles, lambda: self._intake.log_ns()
        )
        self._link = MapperLink(self._setup(), self.outputs, early)
        self._intake = Intake(self._link, self.host_time, put)
        parts, storage = (self._intake, self.outputs, put), self._sinks.map_storage()
        switch = ProfileSwitch(self._present, *parts, storage)
        self._commands = Commands(*parts, self._sinks.session_recorder(), storage, self._find_map, switch)
        self._dispatcher = CommandDispatcher(self._commands.verbs())
        self._report = HealthReport(
            links,
            self._intake,
            self._link,
            self.outputs,
            self._sinks,
            self._latency,
            self._dispatcher,
            lambda: self._present.config,
        )
        self._readers = Readers(
            config.sensors,
            links,
            self._workers,
            self.frame_sink,
            put if self._sinks.wants_raw else None,
            self.host_time.offset_ns,
        )
        self._ready_ns = self._health_due_ns = self._watchdog_due_ns = 0
        self._resume = PointWriter(point_file(config), self._point)
        self._cpu_s = 0.0
        self._last_turn = -1
        self.stopped = False

    def _sink_context(self, links: dict[str, LinkHealth], map_folder: Path | None) -> SinkContext:
        config, begun_in = self._config, self._begun_in
        return SinkContext(
            vehicle=config.vehicle,
            profile=config.mapping.profile,
            stores_graph=begins_in_stored(config.mapping),
            is_localizing=config.mapping.mode == "localization",
            start_unix_ns=self._unix_ns(),
            map_folder=map_folder,
            load_version=None if begun_in is None else begun_in.number,
            folders={
                key: model.directory for key, model in config.sinks.items() if hasattr(model, "directory")
            },
            metadata={
                "corridor": {"version": VERSION, "vehicle": config.vehicle},
                "config": {"yaml": config.text},
                "clock": self._clock_metadata(0),
                **({} if begun_in is None else {"map": begun_in.as_metadata()}),
            },
            tiles=self._tiles,
            links=links,
            command=self._command,
            verbs=lambda: self._dispatcher.verbs,
            emit=self._sinks.put,
            unix_ns=self._unix_ns,
            is_paused=lambda: self._intake.paused,
            present_profile=lambda: self._present.profile,
            pose_sent=self._latency.add,
        )

    @property
    def frame_sink(self) -> Callable[[Frame], None]:
        """Sink for the frames of the drivers, from any thread."""
        return self._intake.put

    @property
    def mapper_pid(self) -> int:
        """Process id of the mapper."""
        return self._link.pid

    @property
    def failure(self) -> str:
        """Which part failed, and how; "" while none has. The service must then be stopped."""
        return self._workers.failure

    @property
    def places(self) -> dict[str, str]:
        """Place of each sink's output, by its name: Zenoh's endpoints, the map's folder ..."""
        return self._sinks.places()

    @property
    def running_status(self) -> RunningStatus | None:
        """Status for a terminal; None before the service is ready."""
        if not self._ready_ns:
            return None
        return running_status(self._report, self.outputs.last, self._latency, self._tiles)

    @property
    def kernels_compiled(self) -> float:
        """Share of the kernels that the mapper's process had to compile and has compiled; 0: none so far."""
        return self._link.kernels_share

    def start(self, cancelled: Callable[[], bool] = lambda: False) -> bool:
        """Start all parts, the mapper first and drivers last; False if `cancelled` meanwhile.

        Raises StorageError where a sink cannot begin, CorridorError where the mapper does not start.
        """
        threading.excepthook = self._thread_died
        if cancelled():  # the sinks may have taken half a second to open
            return False
        if not self._start_mapper(cancelled):
            return False
        self._event("start")
        if mountings(self._config.sensors):
            self._sinks.put(tf_static(self._config.sensors, self._unix_ns()))
        self._sinks.start()
        self._resume.start()
        self._readers.start()
        gc.collect()
        gc.freeze()  # these objects live as long as the process; a full collection would stall the readers
        self._ready_ns, self._cpu_s = time.monotonic_ns(), self._processor_s()
        self._notifier.ready()
        log.info("ready; %s", "; ".join(f"{name}: {place}" for name, place in self.places.items()))
        return True

    def tick(self) -> None:
        """Send watchdog messages and health, each when it is due."""
        now_ns = time.monotonic_ns()
        if self._notifier.watchdog_s is not None and now_ns >= self._watchdog_due_ns:
            self._watchdog_due_ns = now_ns + round(self._notifier.watchdog_s * 1e9)
            self._feed_watchdog()
        if now_ns >= self._health_due_ns:
            self._health_due_ns = now_ns + HEALTH_INTERVAL_NS
            if self._resume_pose is not None and self.outputs.last is not None:
                pose, self._resume_pose = self._resume_pose, None
                self._workers.start("resumed-pose", lambda: self._set_pose(pose))
            self._tell_health(now_ns)

    def stop(self) -> Summary:
        """End drivers, mapper and sinks, in this order, each even if one before it failed."""
        self.stopped = True
        self._notifier.stopping()
        self._notifier.need_more_time(WORKING_S)
        deadline = Deadline()
        stopped_ns = time.monotonic_ns()
        seconds = (stopped_ns - self._ready_ns) / 1e9 if self._ready_ns else 0.0
        cpu_s = self._processor_s() - self._cpu_s
        self._end("the end of drivers", lambda: self._readers.stop(deadline))
        lost: list[str] = []
        self._end("the end of the mapper", lambda: lost.extend(self._stop_mapping(deadline)))
        self._end("the end of commands", self._commands.close)  # a sink waits for one that is not answered
        self._end("the end of the point to resume at", lambda: self._resume.stop(WAKE_S))
        try:
            lost += self._sinks.flush(deadline)
            if self._ready_ns:
                self._end("the last health", lambda: self._tell_health(stopped_ns))
                self._end("the event stop", lambda: self._event("stop", reason=self.failure or "asked to"))
        finally:
            lost += self._sinks.close(deadline)
            threading.excepthook = self._excepthook
            gc.unfreeze()
        if self._ready_ns and not self.failure and not lost:
            self._end("the removal of the point to resume at", self._resume.remove)
        return Summary(
            seconds=round(seconds, 3),
            scans=sum(self.outputs.states.values()),
            scans_dropped=self._report.scans_dropped,
            states={state: self.outputs.states[state] for state in ("ok", "degraded", "lost")},
            latency_ms=self._latency.percentiles(),
            scan_cpu_ms=self.outputs.scan_cpu.percentiles(),
            rates_hz=self._report.mean_rates_hz,
            cpu_percent=round(100.0 * cpu_s / seconds, 1) if seconds else 0.0,
            written=self._sinks.written(),
            utc_offset_ns=self.host_time.offset_ns,
            failure="; ".join(filter(None, [self.failure, *lost])),
        )

    def _end(self, name: str, end: Callable[[], None]) -> None:
        """An error is a failure of the service; recording and map are finished nevertheless."""
        try:
            end()
        except Exception as error:
            log.exception("%s failed", name)
            self._workers.fail(name, error)

    def _start_mapper(self, cancelled: Callable[[], bool]) -> bool:
        """Start the mapper's process, which compiles or loads the kernels; notify systemd of the progress."""
        self._notifier.status("compiling kernels")
        self._notifier.need_more_time(WARM_UP_MORE_S)
        began_s = requested_s = reported_s = time.monotonic()
        self._link.start()
        self._mapping = self._workers.start("mapping", self._link.run)
        warm_up_encoding()
        while not self._link.wait_ready(WAKE_S):
            if cancelled():
                return False
            if self.failure:
                raise CorridorError(self.failure)
            if time.monotonic() - requested_s >= WARM_UP_ASK_S:
                requested_s = time.monotonic()
                self._notifier.need_more_time(WARM_UP_MORE_S)
            if time.monotonic() - reported_s >= WARM_UP_TELL_S:
                reported_s = time.monotonic()
                self._notifier.status(self._link.kernels or f"loading kernels, {reported_s - began_s:.0f} s")
        log.info("mapper ready after %.1f s", time.monotonic() - began_s)
        return True

    def _setup(self) -> Setup:
        config = self._config
        return Setup(
            mapping=config.mapping.model_dump(mode="json", exclude_defaults=True),
            mountings=mountings(config.sensors),
            lasers=mapped_lasers(config),
            upside_down=mounted_upside_down(config.sensors),
            begin_in=str(config.begin_in or ""),
            begin_version=None if self._begun_in is None else self._begun_in.number,
            graph_folder=str(self._sinks.map_storage().graph_folder),
            graph_patience_s=GRAPH_FINISH_S,
            log_level=logging.getLogger().getEffectiveLevel(),
        )

    def _stop_mapping(self, deadline: Deadline) -> list[str]:
        """Map the waiting items, then end the mapper's process. What the map lacks, a sentence each."""
        lacks: list[str] = []
        self._intake.close()
        if self._mapping is not None:
            if self._ready_ns and not self.failure and not self._link.finish(deadline):
                lacks.append("the mapper did not finish; the map lacks what it had not handed over")
                log.error("%s", lacks[0])
            elif self.outputs.graph_fault:
                lacks.append(f"the map lacks loops: {self.outputs.graph_fault}")
            self._link.close()
            self._workers.join(self._mapping, deadline.left_s)
        self._link.clean_up()
        return lacks

    def _feed_watchdog(self) -> None:
        turn = self._link.turns
        if turn == self._last_turn:
            log.error("the mapper's messages were not read for %.1f s", self._notifier.watchdog_s)
        else:
            self._notifier.alive()
        self._last_turn = turn

    def _processor_s(self) -> float:
        return time.process_time() + self.outputs.cpu_s

    def _tell_health(self, now_ns: int) -> None:
        """Counts as they are, freshness as of now_ns: the last time when the drivers were requested to
        end.
        """
        step_before_ns = self._report.clock_step_ns
        self._report.update(now_ns, self.host_time.step_ns(HostTime.now()))
        self._sinks.put(self._report.message(self._unix_ns()))
        for name, state in self._report.take_state_changes():
            self._event("sensor", sensor=name, state=state)
        if (change := self._report.take_mapping_change()) is not None:
            state, reason = change
            words = state if reason == state else f"{state}: {reason}"
            log.log(logging.INFO if state == "ok" else logging.WARNING, "mapping is %s", words)
            self._event("mapping", state=state, reason=reason)
        if self._report.clock_step_ns != step_before_ns:
            self._event("clock_step", step_ns=self._report.clock_step_ns)
            self._sinks.put_metadata("clock", self._clock_metadata(self._report.clock_step_ns))
        self._notifier.status(self._report.line)

    def _command(self, verb: str, payload: bytes) -> Answer:
        return self._dispatcher.answer(verb, payload)

    def _point(self) -> Point | None:
        folder, mapped = self._sinks.map_storage().stored_folder, self.outputs.last
        if folder is None or mapped is None:
            return None
        pose = decode_pose(mapped.messages[0].payload).pose
        return Point(
            folder=folder, unix_ns=time.time_ns(), x_m=pose.x_m, y_m=pose.y_m, theta_rad=pose.theta_rad
        )

    def _set_pose(self, pose: SE2) -> None:
        answer = self._command("set_pose", json.dumps(pose._asdict()).encode())
        if not answer.ok:
            log.warning("the pose before the restart is not taken: %s", answer.body.decode(errors="replace"))

    def _find_map(self, name: str, version: int | None) -> tuple[Path, int]:
        """Folder and version of a stored map that a session can begin in with the present profile.

        Raises CommandError.
        """
        try:
            path = os.path.realpath(self._config.sinks["map"].directory / name)
            return Path(path), stored_for(Path(path), self._present.config, version).number
        except CorridorError as error:
            raise CommandError(str(error)) from error

    def _put_tiles(self, tiles: list[TileUpdate], stamp_ns: int) -> None:
        self._sinks.put_tiles(tiles, stamp_ns, self._unix_ns())

    def _event(self, event: str, **details: str | int) -> None:
        unix_ns = self._unix_ns()
        self._sinks.put(encode_event(json.dumps({"event": event, **details}), unix_ns, unix_ns))

    def _clock_metadata(self, step_ns: int) -> dict[str, str]:
        return {"utc_offset_ns": str(self.host_time.offset_ns), "wall_clock_step_ns": str(step_ns)}

    def _unix_ns(self) -> int:
        return self.host_time.unix_ns(time.monotonic_ns())

    def _thread_died(self, died: threading.ExceptHookArgs) -> None:
        """An exception left a thread that Workers do not watch: of a sink, or an unknown one."""
        name = died.thread.name if died.thread is not None else "a thread"
        error = died.exc_value if died.exc_value is not None else died.exc_type()
        log.error("thread %s failed", name, exc_info=(died.exc_type, error, died.exc_traceback))
        if not self._sinks.thread_died(name, error):
            self._workers.fail(name, error)


def _begun_in(config: ServiceConfig) -> MapVersion | None:
    """The version of the stored map that a session begins in; None: it begins a new map."""
    if config.begin_in is None:
        return None
    try:
        return version_to_begin_in(config.begin_in, config.mapping)
    except InputError as error:
        raise InputError(f"map.load: {error}") from error
