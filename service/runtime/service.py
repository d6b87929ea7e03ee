"""The live service: builds everything from the config, starts it, watches over it, ends it in good order.

    reader threads --frames--> Intake --messages--> publisher's and recorder's threads
    (one a device)               |
                            MapperLink --items--> mapper's process --poses, tiles--> MappingOutputs
                                                                                        |
              publisher; map keeper (disk) <-- TileStore <-- tiles ---------------------'--> as above

The main thread calls `start`, then `tick` several times a second, at last `stop`.
"""

import gc
import json
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from drivers.frames import Frame
from drivers.link import LinkHealth, RawChunk, run_link
from drivers.registry import SENSOR_KINDS
from service.config import ServiceConfig, mapped_lasers, mounted_upside_down, mountings, tf_static
from service.encoding import encode_event, encode_raw
from service.encoding import warm_up as warm_up_encoding
from service.errors import CorridorError, StorageError
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.publishing.commands import CommandDesk
from service.publishing.zenoh_publisher import ZenohPublisher
from service.recording.mcap_recorder import McapRecorder
from service.runtime.commands import Commands
from service.runtime.health import HealthReport
from service.runtime.host_time import HostTime
from service.runtime.intake import Intake
from service.runtime.map_keeper import MapKeeper
from service.runtime.mapper_link import MapperLink
from service.runtime.mapper_messages import Setup
from service.runtime.mapping_outputs import MappingOutputs
from service.runtime.metrics import LatencyHistogram, Percentiles
from service.runtime.notify import Notifier
from service.runtime.workers import Workers
from service.version import VERSION

log = logging.getLogger(__name__)

HEALTH_INTERVAL_NS = 1_000_000_000
WARM_UP_ASK_S = 5.0  # how often systemd hears that kernels are still being compiled
WARM_UP_MORE_S = 60.0  # and how long it may take from then on
WARM_UP_TELL_S = 2.0  # how often the log says that it goes on
READER_STOP_S = 5.0  # a connect to a silent host takes 3 s
GRAPH_FINISH_S = 20.0  # for the last loops, at the end of a run
KEEPER_STOP_S = 20.0
WAKE_S = 0.1  # how often a start looks whether it is cancelled
MAPPING_STOP_S = GRAPH_FINISH_S + 20.0


@dataclass(frozen=True, slots=True)
class Summary:
    """What a run of the service amounted to."""

    seconds: float  # from READY to the end
    scans: int
    scans_dropped: int
    states: dict[str, int]  # scans by state
    latency_ms: Percentiles  # from the last byte of a scan read to its pose put on Zenoh
    scan_cpu_ms: Percentiles  # processor time of a scan in the mapper
    rates_hz: dict[str, float]  # by sensor
    cpu_percent: float  # of one core: this process and the mapper's
    sessions: list[Path]
    map_folder: Path | None  # of the newest map; None where nothing was mapped
    utc_offset_ns: int  # Unix time minus host monotonic time, for the whole run

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "seconds": self.seconds,
            "scans": self.scans,
            "scans_dropped": self.scans_dropped,
            "state": self.states,
            "latency_ms": self.latency_ms.as_dict(),
            "scan_cpu_ms": self.scan_cpu_ms.as_dict(),
            "rates_hz": self.rates_hz,
            "cpu_percent": self.cpu_percent,
            "sessions": [str(path) for path in self.sessions],
            "map": str(self.map_folder) if self.map_folder else None,
        }


class Service:
    """One vehicle's service, of one life: start, tick, stop. Zenoh is open as soon as it is constructed.

    map_folder    where this run's map goes; left out, a folder named by vehicle and time in map.directory
    on_failure    called from any thread when `failure` gets its text

    Raises StorageError where Zenoh cannot listen.
    """

    def __init__(
        self,
        config: ServiceConfig,
        notifier: Notifier,
        map_folder: Path | None = None,
        on_failure: Callable[[], None] = lambda: None,
    ) -> None:
        self._config = config
        self._notifier = notifier
        self.host_time = HostTime.now()
        self._workers = Workers(on_failure)
        self._excepthook = threading.excepthook
        self._stop_drivers = threading.Event()
        self._readers: list[threading.Thread] = []
        self._mapping: threading.Thread | None = None
        self._keeping: threading.Thread | None = None
        self._tiles = TileStore()
        self._latency = LatencyHistogram()
        self._links = {name: LinkHealth(name) for name in config.sensors}
        self._recorder = McapRecorder(
            config.recording.directory,
            config.vehicle,
            rotate_bytes=config.recording.rotate_mb << 20,
            rotate_s=config.recording.rotate_min * 60.0,
            keep_free_bytes=round(config.recording.keep_free_gb * 1e9),
            metadata=self._metadata(),
        )
        self._publisher = ZenohPublisher(config.publishing, config.vehicle, self._tiles, self._latency.add)
        self._outputs = MappingOutputs(
            mapped_lasers(config),
            self._tiles,
            self._publisher.put,
            self._recorder.put,
            self._publish_tiles,
            lambda: self._intake.log_ns(),
        )
        self._link = MapperLink(self._setup(), self._outputs)
        self._intake = Intake(self._link, self.host_time, self._publisher.put, self._recorder.put)
        started = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(self._unix_ns() / 1e9))
        self._keeper = MapKeeper(
            map_folder or config.map.directory / f"{config.vehicle}_{started}",
            self._tiles,
            self.host_time,
            config.map.checkpoint_s,
            {"vehicle": config.vehicle, "profile": config.mapping.profile},
            self._recorder.put,
        )
        self._commands = Commands(self._intake, self._outputs, self._tiles, self._keeper, self._recorder)
        self._desk = CommandDesk(self._commands.verbs())
        self._report = HealthReport(
            self._links,
            self._intake,
            self._link,
            self._outputs,
            self._keeper,
            self._recorder,
            self._publisher,
            self._latency,
            self._desk,
        )
        self._ready_ns = self._health_due_ns = self._watchdog_due_ns = 0
        self._cpu_s = 0.0
        self._last_turn = -1
        self.stopped = False

    @property
    def frame_sink(self) -> Callable[[Frame], None]:
        """Where the drivers put their frames, from any thread."""
        return self._intake.put

    @property
    def mapper_pid(self) -> int:
        """Of the process that maps now."""
        return self._link.pid

    @property
    def failure(self) -> str:
        """Which part failed, and how; "" while all is well. The service must then be stopped."""
        return self._workers.failure

    @property
    def endpoints(self) -> list[str]:
        """Where Zenoh listens."""
        return self._publisher.endpoints

    def start(self, cancelled: Callable[[], bool] = lambda: False) -> bool:
        """Bring everything up, the mapper first and drivers last; False if `cancelled` said so on the way.

        Raises StorageError where the disk cannot be written, CorridorError where the mapper does not start.
        """
        threading.excepthook = self._thread_died
        if not self._start_mapper(cancelled):
            return False
        self._recorder.start()
        self._event("start")
        self._keeping = self._workers.start("map-keeper", self._keeper.run)
        self._start_drivers()
        self._publisher.answer_commands(self._desk.answer)
        gc.collect()
        gc.freeze()  # what stands now stands for the whole run; a full collection would stall the readers
        self._ready_ns, self._cpu_s = time.monotonic_ns(), self._processor_s()
        self._notifier.ready()
        log.info("ready; Zenoh at %s, map in %s", ", ".join(self.endpoints), self._keeper.folder)
        return True

    def tick(self) -> None:
        """Feed the watchdog and tell health, each when it is due."""
        now_ns = time.monotonic_ns()
        if self._notifier.watchdog_s is not None and now_ns >= self._watchdog_due_ns:
            self._watchdog_due_ns = now_ns + round(self._notifier.watchdog_s * 1e9)
            self._feed_watchdog()
        if now_ns >= self._health_due_ns:
            self._health_due_ns = now_ns + HEALTH_INTERVAL_NS
            self._tell_health(now_ns)

    def stop(self) -> Summary:
        """Drivers, queue, map, recording, Zenoh: in this order, each even if one before it failed.

        Raises StorageError where the map could not be saved; everything is ended by then.
        """
        self.stopped = True
        self._notifier.stopping()
        seconds = (time.monotonic_ns() - self._ready_ns) / 1e9 if self._ready_ns else 0.0
        cpu_s = self._processor_s() - self._cpu_s
        self._stop_drivers.set()
        for thread in self._readers:
            self._workers.join(thread, READER_STOP_S)
        map_trouble = self._stop_mapping()
        if self._ready_ns:
            self._tell_health(time.monotonic_ns())
            self._event("stop", reason=self.failure or "asked to")
        sessions = self._recorder.finish()
        self._commands.close()
        self._publisher.close()
        threading.excepthook = self._excepthook
        gc.unfreeze()
        if map_trouble is not None:
            raise map_trouble
        return Summary(
            seconds=round(seconds, 3),
            scans=sum(self._outputs.states.values()),
            scans_dropped=self._report.scans_dropped,
            states={state: self._outputs.states[state] for state in ("ok", "degraded", "lost")},
            latency_ms=self._latency.percentiles(),
            scan_cpu_ms=self._outputs.scan_cpu.percentiles(),
            rates_hz=self._report.mean_rates_hz,
            cpu_percent=round(100.0 * cpu_s / seconds, 1) if seconds else 0.0,
            sessions=sessions,
            map_folder=self._keeper.newest.folder if self._keeper.newest else None,
            utc_offset_ns=self.host_time.offset_ns,
        )

    def _start_mapper(self, cancelled: Callable[[], bool]) -> bool:
        """Start the mapper's process, which compiles or loads the kernels; systemd hears that it goes on."""
        self._notifier.status("compiling kernels")
        self._notifier.need_more_time(WARM_UP_MORE_S)
        began_s = asked_s = told_s = time.monotonic()
        self._link.start()
        self._mapping = self._workers.start("mapping", self._link.run)
        warm_up_encoding()
        while not self._link.wait_ready(WAKE_S):
            if cancelled():
                return False
            if self.failure:
                raise CorridorError(self.failure)
            if time.monotonic() - asked_s >= WARM_UP_ASK_S:
                asked_s = time.monotonic()
                self._notifier.need_more_time(WARM_UP_MORE_S)
            if time.monotonic() - told_s >= WARM_UP_TELL_S:
                told_s = time.monotonic()
                words = self._link.kernels or f"loading kernels since {told_s - began_s:.0f} s"
                self._notifier.status(words)
                log.info("%s; later starts find them", words)
        log.info("mapper ready after %.1f s", time.monotonic() - began_s)
        return True

    def _setup(self) -> Setup:
        config = self._config
        return Setup(
            mapping=config.mapping.model_dump(mode="json", exclude_defaults=True),
            mountings=mountings(config.sensors),
            lasers=mapped_lasers(config),
            upside_down=mounted_upside_down(config.sensors),
            graph_patience_s=GRAPH_FINISH_S,
            log_level=logging.getLogger().getEffectiveLevel(),
        )

    def _start_drivers(self) -> None:
        if mountings(self._config.sensors):
            static = tf_static(self._config.sensors, self._unix_ns())
            self._recorder.put(static)
            self._publisher.put(static)
        for name, sensor in self._config.sensors.items():
            self._readers.append(self._workers.start(f"reader-{name}", self._reader(name, sensor)))

    def _reader(self, name: str, sensor: Any) -> Callable[[], None]:
        kind = SENSOR_KINDS[sensor.type]
        new_session = kind.session_maker(sensor)
        tee = partial(self._tee, name) if self._config.recording.raw else None

        def read() -> None:
            run_link(
                self._links[name],
                lambda: kind.open_transport(sensor),
                new_session,
                self.frame_sink,
                self._stop_drivers,
                tee,
            )

        return read

    def _tee(self, name: str, chunk: RawChunk) -> None:
        self._recorder.put(encode_raw(name, chunk, self.host_time.offset_ns))

    def _stop_mapping(self) -> StorageError | None:
        """Let the mapper take what waits, then save the map. What went wrong with the saving, if anything."""
        self._intake.close()
        self._keeper.stop()
        if self._mapping is not None:
            self._notifier.need_more_time(MAPPING_STOP_S + KEEPER_STOP_S)
            if self._ready_ns and not self.failure and not self._link.finish(MAPPING_STOP_S):
                log.error(
                    "the mapper did not finish within %.0f s; the map lacks its last word", MAPPING_STOP_S
                )
            self._link.close()
            self._workers.join(self._mapping, MAPPING_STOP_S)
        self._link.clean_up()
        if self._keeping is None:
            return None
        try:
            if self._workers.join(self._keeping, KEEPER_STOP_S):
                self._keeper.finish()
        except StorageError as error:
            log.error("%s", error)
            return error
        return None

    def _feed_watchdog(self) -> None:
        turn = self._link.turns
        if turn == self._last_turn:
            log.error("nobody has listened to the mapper for %.1f s", self._notifier.watchdog_s)
        else:
            self._notifier.alive()
        self._last_turn = turn

    def _processor_s(self) -> float:
        return time.process_time() + self._outputs.cpu_s

    def _tell_health(self, now_ns: int) -> None:
        step_before_ns = self._report.clock_step_ns
        self._report.update(now_ns, self.host_time.step_ns(HostTime.now()))
        unix_ns = self.host_time.unix_ns(now_ns)
        self._publisher.put(self._report.message("health", unix_ns))
        self._recorder.put(self._report.message("diagnostics", unix_ns))
        for name, streaming in self._report.streaming.items():
            self._publisher.set_alive(name, streaming)
        for name, state in self._report.take_state_changes():
            self._event("sensor", sensor=name, state=state)
        if self._report.clock_step_ns != step_before_ns:
            self._event("clock_step", step_ns=self._report.clock_step_ns)
            self._recorder.put_metadata("clock", self._clock_metadata(self._report.clock_step_ns))
        self._notifier.status(self._report.line)

    def _publish_tiles(self, tiles: list[TileUpdate], stamp_ns: int) -> None:
        self._publisher.map_changed(tiles, stamp_ns, self._unix_ns())

    def _event(self, event: str, **details: str | int) -> None:
        unix_ns = self._unix_ns()
        self._recorder.put(encode_event(json.dumps({"event": event, **details}), unix_ns, unix_ns))

    def _metadata(self) -> dict[str, dict[str, str]]:
        """What a replay and a reader years later need to know."""
        return {
            "corridor": {"version": VERSION, "vehicle": self._config.vehicle},
            "config": {"yaml": self._config.text},
            "clock": self._clock_metadata(0),
        }

    def _clock_metadata(self, step_ns: int) -> dict[str, str]:
        return {"utc_offset_ns": str(self.host_time.offset_ns), "wall_clock_step_ns": str(step_ns)}

    def _unix_ns(self) -> int:
        return self.host_time.unix_ns(time.monotonic_ns())

    def _thread_died(self, died: threading.ExceptHookArgs) -> None:
        """A thread that Workers do not watch (the publisher's, the recorder's) let an exception out."""
        name = died.thread.name if died.thread is not None else "a thread"
        error = died.exc_value if died.exc_value is not None else died.exc_type()
        log.error("thread %s failed", name, exc_info=(died.exc_type, error, died.exc_traceback))
        self._workers.fail(name, error)
