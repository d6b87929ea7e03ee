"""Session with one LUX: its dialogue over one connection, and scans into frames. No I/O.

Time. Each scan states when its sweep began and ended, on the device's clock, which counts from power-up until
it is set. The end against the arrival feeds the clock map; the stamp of a frame is the moment its first beam
was measured, found from the sweep's begin by the beam's angle. Scans that come before the dialogue is through
are left out: the clock is being set, and what they show may not be what the config requests.
"""

import math
from collections.abc import Callable

import numpy as np

from drivers.counted import counted
from drivers.dialogue import DialogueRunner
from drivers.errors import DeviceError, ProtocolError, TransportError
from drivers.frames import NO_INTENSITY, LaserScan
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.device_clock import NEAR_SCANS, NUMBER_MODULUS, DeviceClock
from drivers.ibeo_lux.dialogue import Ask, IbeoLuxDialogue, status_faults
from drivers.ibeo_lux.messages import (
    TICKS_PER_DEG,
    TICKS_PER_TURN,
    Command,
    ErrorRegisters,
    Reply,
    Scan,
    ScanFlag,
    ScannerStatus,
    read_reply,
    read_scan,
    write_command,
)
from drivers.ibeo_lux.protocol import FOREIGN_SCANS, DataType, Decoder, Message, encode, ntp_difference_ns
from drivers.ibeo_lux.reduction import LayerReduction, sound_points
from drivers.rates import same_rate
from drivers.watch import OUTSIDE, WatchedSession

FIRST_SCAN_TIMEOUT_S = 20.0  # a recorded dialogue has its first scan 5 s after Start
REPORT_SHOWN_NS = 15_000_000_000  # what the device last reported, or did, so long ago stays in the status
GRAVE_ERRORS = (
    "motor",
    "APD",
    "internal error",
    "no scan data",
    "FPGA",
    "bad configuration",
    "bad parameter",
)
MALFORMED_LIMIT = 20  # scans in a row
REPEATED_LIMIT = 20  # scans in a row
OTHER_LIMIT = 10  # scans in a row
MIN_TURN_NS, MAX_TURN_NS = 10_000_000, 160_000_000  # of the mirror; 20 to 80 ms are requested
DEVICE_ID = 1
COUNTED_TYPES: dict[int, str] = {
    DataType.OBJECTS: "object_lists_ignored",
    DataType.VEHICLE_STATE: "vehicle_states_ignored",
    DataType.VEHICLE_STATE_ECU: "vehicle_states_ignored",
    DataType.LOG_ERROR: "log_texts_ignored",
    DataType.LOG_WARNING: "log_texts_ignored",
    DataType.LOG_NOTE: "log_texts_ignored",
    DataType.LOG_DEBUG: "log_texts_ignored",
}


class IbeoLuxSession(WatchedSession):
    """The life of one connection; see drivers.link.Session. The device's clock is set to `unix_ns`."""

    _clock: DeviceClock

    def __init__(self, config: IbeoLuxConfig, unix_ns: Callable[[], int]) -> None:
        self._config = config
        self._decoder = Decoder()
        self._dialogue = IbeoLuxDialogue(config, unix_ns)
        super().__init__("scans", self._dialogue.counters, MALFORMED_LIMIT)
        self._dialogue.explain_faults = lambda: ", ".join(self._errors_shown())
        self._runner: DialogueRunner[Ask, Reply] = DialogueRunner(self._dialogue.run)
        self._now_ns: int | None = None
        self._latency_ns = round(config.latency_ms * 1e6)
        self._clock = DeviceClock(self._latency_ns)
        self._clock_stands = False  # the newest scan has the time of the one before
        self._last: Scan | None = None
        self._truncated_ns: int | None = None  # when the newest one that is came
        self._repeated_in_a_row = 0
        self._other_in_a_row = 0
        self._was_as_configured = False
        self._errors: dict[str, int] = {}  # words -> when last reported
        self._warnings: dict[str, int] = {}
        self.identity = self._dialogue.identity
        self.status = self._dialogue.phase
        self._reduction = LayerReduction(config, self.counters)

    def receive_data(self, data: bytes, arrived_ns: int) -> list[LaserScan]:
        self._now_ns = arrived_ns if self._now_ns is None else max(self._now_ns, arrived_ns)
        frames = []
        for message in self._decoder.receive_data(data):
            match message.data_type:
                case DataType.SCAN:
                    if (frame := self._take_scan(message, arrived_ns)) is not None:
                        frames.append(frame)
                case DataType.REPLY:
                    self._take_reply(message, arrived_ns)
                case DataType.ERRORS:
                    self._take_errors(message, arrived_ns)
                case other:
                    self._pass_over(other)
        self._count(
            bytes_skipped=self._decoder.skipped_bytes,
            bad_headers=self._decoder.bad_headers,
            messages_cut=self._decoder.cut_messages,
        )
        self._set_status()
        return frames

    def tick(self, now_ns: int) -> None:
        self._now_ns = now_ns
        if (requested := self._runner.tick(now_ns)) is not None:
            payload = write_command(requested.command, requested.body)
            self.outbox += encode(Message(DataType.COMMAND, payload, DEVICE_ID))
        self._take_over()
        self._silence.look(now_ns, waiting=self._dialogue.ready)
        limit_s = FIRST_SCAN_TIMEOUT_S if self._last is None else self._config.silence_timeout_s
        if self._silence.exceeds(limit_s):
            self._give_up(limit_s)
        self._set_status()

    def shutdown_request(self) -> bytes:
        """Nothing: the device goes on measuring, as it does by itself after power-up."""
        return b""

    def _give_up(self, silent_s: float) -> None:
        """Raises DeviceError where the device reported a fault that ends the scans, else TransportError."""
        facts = self._errors_shown()
        grave = any(text.startswith(GRAVE_ERRORS) for text in facts)
        if self._last is not None:
            facts += status_faults(self._last.status)
        elif self._dialogue.device_status is not None:
            facts += status_faults(self._dialogue.device_status.status)
            grave = grave or bool(status_faults(self._dialogue.device_status.status))
        if grave:
            raise DeviceError(f"no scan for {silent_s:g} s, the device reports: {', '.join(facts)}")
        if self._dialogue.foreign:
            raise TransportError(
                f"no scan of a LUX for {silent_s:g} s, but those of {self._dialogue.foreign}; wrong address?"
            )
        if self._repeated_in_a_row > REPEATED_LIMIT:
            raise TransportError(f"no new scan for {silent_s:g} s: it repeats the same one")
        if came := self._silence.what_came("scans", silent_s):
            raise TransportError(came)
        raise TransportError(
            f"no scan for {silent_s:g} s{''.join(f', it reported {text}' for text in facts)}; is the device "
            "rebooting, was it stopped, or is the cable out?"
        )

    def _take_reply(self, message: Message, now_ns: int) -> None:
        try:
            reply = read_reply(message.payload)
        except ProtocolError:
            self.counters["replies_unusable"] += 1
            return
        requested = self._runner.awaited
        if requested is None or not _answers(reply, requested):
            self.counters["replies_not_asked_for"] += 1
            return
        self._runner.answer(reply, now_ns)
        self._take_over()

    def _take_over(self) -> None:
        """Take over the geometry that the dialogue has read."""
        self._reduction.beam_tilt_rad = self._dialogue.beam_tilt_rad
        self._reduction.upside_down = self._dialogue.upside_down

    def _take_errors(self, message: Message, now_ns: int) -> None:
        try:
            registers = ErrorRegisters.read(message.payload)
        except ProtocolError:
            self.counters["error_messages_unusable"] += 1
            return
        for kind, words, facts in (
            ("error", registers.error_words, self._errors),
            ("warning", registers.warning_words, self._warnings),
        ):
            for text in words:
                self.counters[f"{kind}: {text}"] += 1
                facts[text] = now_ns

    def _pass_over(self, data_type: int) -> None:
        self.counters[COUNTED_TYPES.get(data_type, "other_messages_ignored")] += 1
        self._dialogue.foreign = FOREIGN_SCANS.get(data_type, self._dialogue.foreign)

    def _errors_shown(self) -> list[str]:
        return self._shown(self._errors)

    def _shown(self, facts: dict[str, int]) -> list[str]:
        return [text for text, reported_ns in facts.items() if self._is_shown(reported_ns)]

    def _is_shown(self, reported_ns: int) -> bool:
        return reported_ns >= (self._now_ns or 0) - REPORT_SHOWN_NS

    def _set_status(self) -> None:
        state = self._dialogue.phase if self._last is None else "streaming"
        parts = [state]
        if self._last is not None:
            parts += status_faults(self._last.status)
            synced = self._last.status & ScannerStatus.SYNC_SEEN
            if self._config.sync_angle_deg is not None and not synced:
                parts.append("no external synchronisation signal")
            if self._repeated_in_a_row > REPEATED_LIMIT:
                parts.append("the same scan again and again, not used")
            elif self._clock_stands:
                parts.append("its clock stands still, stamps are those of arrival")
            if self._truncated_ns is not None and self._is_shown(self._truncated_ns):
                count = self.counters["scans_truncated"]
                parts.append(f"scans with fewer points than announced, {count} so far")
            if self._dialogue.other_scans and self._other_in_a_row > OTHER_LIMIT:
                parts.append(f"scans at {self._dialogue.other_scans}")
            parts += self._dialogue.refusals
        parts += [f"error: {text}" for text in self._errors_shown()]
        parts += [f"warning: {text}" for text in self._shown(self._warnings)]
        status = self._dialogue.device_status
        if self._last is not None and status is not None and status.temperature_c is not None:
            parts.append(f"{status.temperature_c:.0f} C")
        self.status = "; ".join(parts)

    def _take_scan(self, message: Message, arrived_ns: int) -> LaserScan | None:
        self._dialogue.scans_seen += 1
        try:
            scan = read_scan(message.payload)
            _check(scan)
        except ProtocolError as error:
            self._malformed.bad(error)
            return None
        self._malformed.good()
        self.counters["scans_received"] += 1
        if scan.is_truncated:
            self.counters["scans_truncated"] += 1
            self._truncated_ns = arrived_ns
        if not self._dialogue.ready:
            self.counters["scans_before_ready"] += 1
            return None
        if not self._is_new(scan):
            return None
        last, self._last = self._last, scan
        self._clock_stands = last is not None and scan.start_ntp == last.start_ntp
        return self._frame(scan, arrived_ns)

    def _is_new(self, scan: Scan) -> bool:
        """Whether the scan is new; also counts the missing ones before it."""
        last = self._last
        if last is None:
            return True
        same_header = scan.number == last.number and scan.start_ntp == last.start_ntp
        if same_header and np.array_equal(scan.points, last.points):
            self.counters["scans_repeated"] += 1
            self._repeated_in_a_row += 1
            return False
        self._repeated_in_a_row = 0
        gap = (scan.number - last.number) % NUMBER_MODULUS
        if same_header:
            self.counters["scans_of_one_number"] += 1
        elif 1 <= gap <= 10 * NEAR_SCANS:
            self.counters["scans_missed"] += gap - 1
        else:
            self.counters["scan_number_restarts"] += 1
        return True

    def _frame(self, scan: Scan, arrived_ns: int) -> LaserScan | None:
        sweep_ns = ntp_difference_ns(scan.end_ntp, scan.start_ntp)
        sweep_ticks = scan.start_ticks - scan.end_ticks
        period_ns = round(sweep_ns * scan.ticks_per_turn / sweep_ticks)
        if self._clock_stands:
            self.counters["scans_stamped_by_arrival"] += 1
        else:
            self._clock.observe(scan, period_ns, arrived_ns)
        self._count(clock_resets=self._clock.resets)
        self._check_against_config(scan, period_ns)
        if not self._is_side_wanted(scan):
            self._silence.heard()  # its frame is not used, but it is valid
            self.counters["scans_of_other_mirror_side"] += 1
            return None
        if not self._reduction.sees(scan):
            self.counters["scans_outside_field_of_view"] += 1
            self._silence.dropped(OUTSIDE)
            return None
        beams = self._reduction.reduce(scan)
        tick_ns = sweep_ns / sweep_ticks
        stamp_ns = (
            arrived_ns - sweep_ns - self._latency_ns
            if self._clock_stands
            else self._clock.to_host_ns(scan.start_ntp)
        )
        stamp_ns -= round((beams.first_ticks - scan.start_ticks) * tick_ns)
        if not self._gate.passes(stamp_ns, arrived_ns):
            return None
        self._silence.heard()
        radians_per_tick = 2.0 * math.pi / scan.ticks_per_turn
        return LaserScan(
            sensor=self._config.name,
            stamp_ns=stamp_ns,
            arrived_ns=arrived_ns,
            beam_interval_ns=round(beams.step_ticks * tick_ns),
            scan_period_ns=period_ns if self._config.mirror_sides == "both" else 2 * period_ns,
            first_angle_rad=beams.first_ticks * radians_per_tick,
            angle_step_rad=-beams.step_ticks * radians_per_tick,
            range_min_m=self._config.range_min_m,
            range_max_m=self._config.range_max_m,
            range_m=beams.range_m,
            intensity=beams.width_cm if self._config.intensity else NO_INTENSITY,
        )

    def _is_side_wanted(self, scan: Scan) -> bool:
        side = "rear" if scan.flags & ScanFlag.REAR_MIRROR_SIDE else "front"
        return self._config.mirror_sides in ("both", side)

    def _check_against_config(self, scan: Scan, period_ns: int) -> None:
        """Raises TransportError where a device that was as configured no longer is: a restart forgets."""
        config = self._config
        rate_hz = 1e9 / period_ns
        angles = (scan.start_ticks, scan.end_ticks)
        wanted = (config.first_ticks, config.last_ticks)
        if same_rate(rate_hz, config.scan_rate_hz) and angles == wanted:
            self._other_in_a_row, self._was_as_configured = 0, True
            self._dialogue.other_scans = ""
            return
        self.counters["scans_not_as_configured"] += 1
        self._other_in_a_row += 1
        found, set_to = _words(rate_hz, angles), _words(config.scan_rate_hz, wanted)
        is_cut = angles[0] > wanted[0] or angles[1] < wanted[1]
        cut = ", cut to these angles by the driver" if is_cut else ""
        self._dialogue.other_scans = f"{found}, configured {set_to}{cut}"
        if self._was_as_configured and self._other_in_a_row > OTHER_LIMIT:
            raise TransportError(
                f"{self._other_in_a_row} scans in a row at {found}, set was {set_to}; "
                "it restarted or another host changed it"
            )


def _words(rate_hz: float, angles_ticks: tuple[int, int]) -> str:
    first_deg, last_deg = (ticks / TICKS_PER_DEG for ticks in angles_ticks)
    return f"{rate_hz:.3g} Hz from {first_deg:g} to {last_deg:g} deg"


def _answers(reply: Reply, requested: Ask) -> bool:
    """A late reply about another parameter does not."""
    if reply.command != requested.command:
        return False
    return reply.refused or reply.command != Command.GET_PARAMETER or reply.body[:2] == requested.body


def _check(scan: Scan) -> None:
    """Raises ProtocolError where no time or direction can be had from the header, or of no point."""
    if scan.ticks_per_turn != TICKS_PER_TURN:
        raise ProtocolError(
            f"a scan with {counted(scan.ticks_per_turn, 'tick')} a turn, expected {TICKS_PER_TURN}"
        )
    sweep_ticks = scan.start_ticks - scan.end_ticks
    if not 0 < sweep_ticks <= TICKS_PER_TURN:
        raise ProtocolError(
            f"a scan from {scan.start_ticks} to {scan.end_ticks} ticks, expected a sweep from left to right"
        )
    turn_ns = ntp_difference_ns(scan.end_ntp, scan.start_ntp) * TICKS_PER_TURN / sweep_ticks
    if not MIN_TURN_NS <= turn_ns <= MAX_TURN_NS:
        raise ProtocolError(
            f"a scan at {turn_ns / 1e6:g} ms a turn of the mirror, expected 20, 40 or 80 ms; "
            "its begin and end stamps do not fit"
        )
    if len(scan.points) and not sound_points(scan).any():
        raise ProtocolError(
            f"a scan of {counted(len(scan.points), 'point')}, none with a layer, an echo and an "
            f"angle that can be; the "
            f"first begins with 0x{scan.points[:1].tobytes()[:4].hex()}"
        )
