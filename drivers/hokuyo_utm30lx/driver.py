"""Session with one Hokuyo laser: its dialogue over one connection, and scans into frames. No I/O.

Time. Each scan is stamped in integer milliseconds with the moment its sweep began: step 0 by C-42-03320B,
while ros-drivers/urg_node takes it for the moment the mirror looked straight back (stamp_moment: rear).
ScanClock makes host time of it; from there the first beam requested is some steps away.
"""

import numpy as np
import numpy.typing as npt

from drivers.dialogue import DialogueRunner
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.frames import NO_INTENSITY, LaserScan, no_distance
from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.dialogue import Answer, Ask, UtmDialogue, status_text
from drivers.hokuyo_utm30lx.geometry import Geometry
from drivers.hokuyo_utm30lx.protocol import (
    ABNORMAL,
    GENERAL_STATUS,
    OK,
    RESUMED,
    SCAN_FOLLOWS,
    Reply,
    ReplyDecoder,
)
from drivers.hokuyo_utm30lx.scan_clock import ScanClock
from drivers.hokuyo_utm30lx.scans import NO_ECHO, Scan, ScanRequest, read_scan
from drivers.watch import DAMAGED, SAME_STAMP, DropReason, WatchedSession

FIRST_SCAN_TIMEOUT_S = 10.0  # the motor may have to come to speed
MALFORMED_LIMIT = 40  # scans in a row
SENDING_NS = 300_000  # from the last beam to arrival, an estimate until TM1 is measured
VERIFYING, HARDWARE_FAULTS = range(21, 50), range(50, 98)  # statuses in a stream
OTHER_REQUEST = DropReason(
    "of another request than was made",
    "another program asks the same laser: stop it; if there is none, it answers as no Hokuyo laser does",
)

Rows = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]  # (N,) range in m, (N,) or (0,) intensity


class HokuyoUtm30lxSession(WatchedSession):
    """The life of one connection; see drivers.link.Session."""

    _clock: ScanClock | None = None

    def __init__(self, config: HokuyoUtm30lxConfig) -> None:
        self._config = config
        self._decoder = ReplyDecoder()
        self._dialogue = UtmDialogue(config)
        super().__init__("scans", self._dialogue.counters, MALFORMED_LIMIT)
        self._runner: DialogueRunner[Ask, Answer] = DialogueRunner(self._dialogue.run)
        self._last_ms: int | None = None
        self._verifying = ""
        self._no_distance = no_distance()  # by code, of the connected laser
        self.outbox += b"\n"  # ends a command that an earlier client left incomplete
        self.identity = self._dialogue.identity
        self.status = self._dialogue.phase

    def receive_data(self, data: bytes, arrived_ns: int) -> list[LaserScan]:
        scans = []
        for reply in self._decoder.receive_data(data):
            requested = self._runner.awaited
            answers = requested is not None and reply.echo == requested.command
            if answers and reply.status != SCAN_FOLLOWS:  # else its answer was damaged; it is queried again
                self._runner.answer(Answer(reply, self._runner.requested_ns, arrived_ns), arrived_ns)
                if self._runner.ended:
                    self._begin_stream()
            elif reply.echo[0] in "MN" and reply.status != OK:
                if (scan := self._take_scan(reply, arrived_ns)) is not None:
                    scans.append(scan)
            else:
                self.counters["answers_not_asked_for"] += 1
        unreadable = self._decoder.unreadable_blocks - self.counters["replies_unreadable"]
        self._silence.dropped(DAMAGED, unreadable)
        self._count(
            bytes_skipped=self._decoder.skipped_bytes, replies_unreadable=self._decoder.unreadable_blocks
        )
        self._set_status()
        return scans

    def tick(self, now_ns: int) -> None:
        if (requested := self._runner.tick(now_ns)) is not None:
            self.outbox += requested.command.encode("ascii") + b"\n"
        limit_s = FIRST_SCAN_TIMEOUT_S if self._last_ms is None else self._config.silence_timeout_s
        nothing = f"no scan for {limit_s:g} s; did it lose power or reboot?"
        self._end_where_silent(now_ns, limit_s, self._dialogue.request is not None, nothing)
        self._set_status()

    def shutdown_request(self) -> bytes:
        return b"QT\n" if self._runner.begun else b""  # without it a USB unit goes on streaming

    def _begin_stream(self) -> None:
        dialogue = self._dialogue
        geometry, request = dialogue.geometry, dialogue.request
        assert geometry is not None
        assert request is not None
        sweep_ns = (request.last_step - self._stamped_step(geometry)) * geometry.step_ns
        self._clock = ScanClock(geometry.turn_ns * (1 + request.skip), round(sweep_ns) + SENDING_NS)
        if dialogue.time_samples:
            self._clock.synchronise(dialogue.time_samples)

    def _stamped_step(self, geometry: Geometry) -> float:
        """Step at which the device stamps a scan."""
        if self._config.stamp_moment == "rear":
            return geometry.front_step - geometry.steps_per_turn / 2
        return 0.0

    def _set_status(self) -> None:
        if self._last_ms is None:
            self.status = self._dialogue.phase
        else:
            parts = (self._verifying, self._dialogue.fault, *self._dialogue.refusals)
            self.status = "; ".join(text for text in ("streaming", *parts) if text)

    def _take_scan(self, reply: Reply, arrived_ns: int) -> LaserScan | None:
        request = self._dialogue.request
        if request is None:
            self.counters["scans_of_old_stream"] += 1
            return None
        if reply.echo != request.text:
            self.counters["scans_of_old_stream"] += 1
            self._silence.dropped(OTHER_REQUEST)
            return None
        if reply.status != SCAN_FOLLOWS and not reply.body:
            self._note_status(reply.status)
            return None
        try:
            if reply.status != SCAN_FOLLOWS:
                raise ProtocolError(f"{reply.echo}: a scan with status {reply.status}, expected 99")
            scan = read_scan(reply)
        except ProtocolError as error:
            self._malformed.bad(error)
            return None
        self._malformed.good()
        self.counters["scans_received"] += 1
        return self._frame(scan, request, arrived_ns)

    def _note_status(self, status: str) -> None:
        """Statuses without a scan: the device checks an error, reports a fault, or refuses to continue."""
        number = int(status) if status.isdigit() else 0
        if status == RESUMED:
            self._verifying = ""
        elif number in VERIFYING:
            self.counters["stops_to_verify_an_error"] += 1
            self._verifying = f"stopped to verify an error (status {status})"
        elif number in HARDWARE_FAULTS:
            raise DeviceError(f"hardware fault (status {status}); cut its power once, else have it repaired")
        elif status == ABNORMAL:
            raise DeviceError(f"the stream ended: {status_text(status)}; it is rebooted at the next try")
        elif status in GENERAL_STATUS:
            raise TransportError(f"the stream ended: {status_text(status)}")
        else:
            self.counters["answers_unusable"] += 1

    def _frame(self, scan: Scan, request: ScanRequest, arrived_ns: int) -> LaserScan | None:
        geometry, clock = self._dialogue.geometry, self._clock
        assert geometry is not None
        assert clock is not None
        if scan.stamp_ms == self._last_ms:
            self.counters["scans_with_a_stamp_twice"] += 1
            self._silence.dropped(SAME_STAMP)
            return None
        resets = clock.resets
        moment_ns = clock.stamp(scan.stamp_ms, arrived_ns)
        self._last_ms = scan.stamp_ms
        self._count(
            clock_resets=clock.resets,
            time_sync_contradictory=clock.contradictions,
            scans_stamped_too_close=clock.too_close,
        )
        step_ns = clock.period_ns / (1 + request.skip) / geometry.steps_per_turn
        first_beam_ns = (geometry.first_beam_step(request) - self._stamped_step(geometry)) * step_ns
        stamp_ns = moment_ns + round(first_beam_ns) - round(self._config.latency_ms * 1e6)
        last_ns = self._gate.last_ns
        if not self._gate.passes(stamp_ns, arrived_ns):
            return None
        if last_ns is not None and clock.resets == resets:
            missed = round((stamp_ns - last_ns) / clock.period_ns) - 1
            if missed > 0:
                self.counters["scans_missed"] += missed
        self._silence.heard()
        self._verifying = ""  # it measures again, also where the reply that reports it was lost
        range_m, intensity = self._convert(scan, geometry)
        cluster = max(request.cluster, 1)
        return LaserScan(
            sensor=self._config.name,
            stamp_ns=stamp_ns,
            arrived_ns=arrived_ns,
            beam_interval_ns=round(cluster * step_ns),
            scan_period_ns=round(clock.period_ns),
            first_angle_rad=geometry.first_angle_rad(request),
            angle_step_rad=cluster * geometry.step_rad,
            range_min_m=self._config.range_min_m,
            range_max_m=self._config.range_max_m,
            range_m=range_m,
            intensity=intensity,
        )

    def _convert(self, scan: Scan, geometry: Geometry) -> Rows:
        """Range in m with NaN for every code that is no distance, and intensity in device units."""
        distance_mm = scan.distance_mm
        self._count_codes(distance_mm[0], geometry)
        row = self._chosen_echo(scan, geometry)
        if row is not None:
            distance_mm = np.take_along_axis(distance_mm, row[np.newaxis], axis=0)
        range_m = (distance_mm[0] / 1000.0).astype(np.float32)
        range_m[~_is_distance(distance_mm[0], geometry)] = np.nan
        is_code = (distance_mm[0] >= 0) & (distance_mm[0] < geometry.distance_min_mm)
        if len(self._no_distance) != geometry.distance_min_mm:
            self._no_distance = no_distance(*map(self._cause, range(geometry.distance_min_mm)))
        range_m[is_code] = self._no_distance[distance_mm[0][is_code]]
        if not (self._config.intensity and len(scan.intensity)):
            return range_m, NO_INTENSITY
        intensity = (
            scan.intensity if row is None else np.take_along_axis(scan.intensity, row[np.newaxis], axis=0)
        )
        return range_m, intensity[0].astype(np.float32)

    def _chosen_echo(self, scan: Scan, geometry: Geometry) -> npt.NDArray[np.int64] | None:
        """(N,) row of the chosen echo, or None where there is only the first."""
        echoes = len(scan.distance_mm)
        if echoes == 1:
            return None
        there = scan.distance_mm != NO_ECHO
        self.counters["beams_with_further_echoes"] += int(np.count_nonzero(there[1]))
        there &= _is_distance(scan.distance_mm, geometry)
        if self._config.echo == "strongest":
            score = np.where(there, scan.intensity, NO_ECHO)
        else:
            score = np.where(there, np.arange(echoes)[:, np.newaxis], NO_ECHO)
        rows: npt.NDArray[np.int64] = np.argmax(score, axis=0)
        return rows

    def _cause(self, code: int) -> str:
        return self._config.limits.codes.get(code, "other_error")

    def _count_codes(self, first_mm: npt.NDArray[np.int32], geometry: Geometry) -> None:
        for code, count in enumerate(np.bincount(first_mm[first_mm < geometry.distance_min_mm])):
            if count:
                self.counters["beams_" + self._cause(code)] += int(count)
        beyond = np.count_nonzero(first_mm >= geometry.distance_max_mm)
        if beyond:
            self.counters["beams_beyond_range"] += int(beyond)


def _is_distance(distance_mm: npt.NDArray[np.int32], geometry: Geometry) -> npt.NDArray[np.bool_]:
    return (distance_mm >= geometry.distance_min_mm) & (distance_mm < geometry.distance_max_mm)
