"""Session with one SICK scanner: its dialogue over one connection, and scan telegrams into frames. No I/O.

Time. The device counts microseconds since power-on and stamps each telegram twice: the zero index, and when
it was handed to the network. The second against the arrival feeds the clock map, the first is translated by
it. The listing puts the zero index before the measurement. The recorded LMS111 (V1.80.2) however sends
complete telegrams 3.1 ms after it, while its sweep takes 15 ms, so there it lies behind the sweep. A telegram
cannot leave before its last beam: where the two stamps show it, the first beam is put one sweep before
sending. So do a recorded TiM551 (3.8 ms) and TiM781S (7.7 ms), whose sweep takes 50 ms. A recorded LMS511
sends 40.9 ms after it, its turn taking 40 ms: there the zero index comes first, and is taken for the first
beam.
"""

import math

import numpy as np
import numpy.typing as npt

from drivers.clock import ClockMap
from drivers.dialogue import DialogueRunner
from drivers.errors import ProtocolError, TransportError
from drivers.frames import NO_INTENSITY, LaserScan, no_distance
from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.dialogue import ANSWERS, DIALECTS, Ask, Lms100Dialogue
from drivers.sick_lms100.protocol import Decoder, Telegram, encode, writer
from drivers.sick_lms100.telegrams import (
    ANGLE_SLACK_E4DEG,
    FIRST_RANGE_CODE,
    FULL_TURN_E4DEG,
    LOW_CODES,
    Channel,
    OutputRange,
    ScanConfig,
    ScanTelegram,
    exact_step_deg,
    read_scan,
)
from drivers.watch import OUTSIDE, SAME_STAMP, DropReason, WatchedSession

_NO_DISTANCE = no_distance(*(LOW_CODES.get(code, "reserved_code") for code in range(FIRST_RANGE_CODE)))
FIRST_SCAN_TIMEOUT_S = 45.0  # after a change of the scan rate data flow again after some 30 s
MALFORMED_LIMIT = 20  # scan telegrams in a row
FLAGGED_SCANS_ARE_A_FAULT = 50  # the first 7 or so after a start carry the error flag and are good
OTHER_LIMIT = 10  # scans in a row that are not as configured
COUNTER_GAP_IS_A_RESTART = 1_000
COUNTER_MODULUS = 1 << 16
CLOCK_MODULUS = 1 << 32

NO_SCAN_RATE = DropReason(
    "with a scan rate of 0 Hz", "the sensor does not know how fast it turns: switch its power off and on"
)


STATUS_BITS = {1: "device error", 2: "contamination warning", 4: "contamination error"}

Echoes = list[tuple[Channel, Channel | None]]  # distance and remission of each echo, first echo first
Rows = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]  # (N,) range in m, (N,) or (0,) intensity


class Lms100Session(WatchedSession):
    """The life of one connection; see drivers.link.Session."""

    _clock: ClockMap

    def __init__(self, config: Lms100Config) -> None:
        self._config = config
        self._limits = config.limits
        self._decoder = Decoder(DIALECTS.get(config.dialect))
        self._dialogue = Lms100Dialogue(config)
        super().__init__("scans", self._dialogue.counters, MALFORMED_LIMIT)
        self._runner: DialogueRunner[Ask, Telegram] = DialogueRunner(self._dialogue.run)
        self._clock = ClockMap(1_000.0, CLOCK_MODULUS, round(config.latency_ms * 1e6))
        self._sweep_measured: tuple[int, int] | None = None  # frequency and last angle of _least_sending_us
        self._least_sending_us = 0  # from the zero index to the sending, of all scans of that sweep
        self._last: ScanTelegram | None = None
        self._flagged_in_a_row = 0
        self._other_in_a_row = 0
        self._other_scans = ""  # how they differ from the config
        self._was_as_configured = False
        self.identity = self._dialogue.identity
        self.status = self._dialogue.phase

    def receive_data(self, data: bytes, arrived_ns: int) -> list[LaserScan]:
        scans = []
        for telegram in self._decoder.receive_data(data):
            if telegram.kind == "sSN":
                if telegram.name != "LMDscandata":
                    self.counters["events_ignored"] += 1
                elif (scan := self._to_frame(telegram, arrived_ns)) is not None:
                    scans.append(scan)
            else:
                self._take_answer(telegram, arrived_ns)
        self._count(bytes_skipped=self._decoder.skipped_bytes, checksum_errors=self._decoder.bad_checksums)
        self._set_status()
        return scans

    def tick(self, now_ns: int) -> None:
        if (requested := self._runner.tick(now_ns)) is not None:
            self.outbox += encode(requested.request)
        self._choose_dialect()
        limit_s = FIRST_SCAN_TIMEOUT_S if self._last is None else self._config.silence_timeout_s
        nothing = f"no scan for {limit_s:g} s; is the device in standby, rebooting or is the cable out?"
        self._end_where_silent(now_ns, limit_s, self._dialogue.subscribed, nothing)
        self._set_status()

    def shutdown_request(self) -> bytes:
        if self._dialogue.dialect is None or not self._runner.begun:
            return b""
        w = writer(self._dialogue.dialect)
        w.u8(0)
        return encode(Telegram(self._dialogue.dialect, "sEN", "LMDscandata", w.body))

    def _take_answer(self, telegram: Telegram, now_ns: int) -> None:
        requested = self._runner.awaited
        if requested is None or (telegram.kind != "sFA" and telegram.name != requested.request.name):
            self.counters["answers_not_asked_for"] += 1
        elif telegram.kind == "sMA":  # accepted, the answer follows
            self._runner.wait_again(now_ns)
        elif telegram.kind == "sFA" or telegram.kind in ANSWERS:
            self._runner.answer(telegram, now_ns)
            self._choose_dialect()

    def _choose_dialect(self) -> None:
        if self._dialogue.dialect is not None:
            self._decoder.dialect = self._dialogue.dialect

    def _set_status(self) -> None:
        if self._last is None:
            self.status = self._dialogue.phase
            return
        faults = [self._dialogue.fault] if self._dialogue.fault else []
        if self._flagged_in_a_row >= FLAGGED_SCANS_ARE_A_FAULT:
            flags = self._last.status[0] | self._last.status[1]
            faults += [text for bit, text in STATUS_BITS.items() if flags & bit]
        if not self._last.frequency_chz:
            faults.append("scans with a scan rate of 0 Hz, not used")
        if self._other_in_a_row > OTHER_LIMIT:
            faults.append(f"scans at {self._other_scans}")
        faults += self._dialogue.refusals
        self.status = "; ".join(dict.fromkeys(["streaming", *faults]))

    def _to_frame(self, telegram: Telegram, arrived_ns: int) -> LaserScan | None:
        self._dialogue.scans_seen += 1
        try:
            scan = read_scan(telegram)
            echoes = self._echoes(scan)
        except ProtocolError as error:
            self._malformed.bad(error)
            return None
        self._malformed.good()
        self.counters["scans_received"] += 1
        if not self._is_new(scan):
            return None
        self._note_flags(scan)
        self._last = scan
        if not scan.frequency_chz:  # without it no beam has a time
            self.counters["scans_without_scan_rate"] += 1
            self._silence.dropped(NO_SCAN_RATE)
            return None
        return self._frame(scan, echoes, arrived_ns)

    def _is_new(self, scan: ScanTelegram) -> bool:
        """Whether the scan is new; also counts the missing ones before it."""
        last = self._last
        if last is None:
            return True
        if scan.scan_counter == last.scan_counter and scan.start_us == last.start_us:
            self.counters["scans_duplicate"] += 1
            self._silence.dropped(SAME_STAMP)
            return False
        gap = (scan.scan_counter - last.scan_counter) % COUNTER_MODULUS
        if 1 <= gap <= COUNTER_GAP_IS_A_RESTART:
            self.counters["scans_missed"] += max(0, round(gap / self._dialogue.scan_interval) - 1)
        else:
            self.counters["scan_counter_restarts"] += 1
        return True

    def _note_flags(self, scan: ScanTelegram) -> None:
        flags = scan.status[0] | scan.status[1]
        if not flags:
            self._flagged_in_a_row = 0
            return
        self._flagged_in_a_row += 1
        for bit, text in STATUS_BITS.items():
            if flags & bit:
                self.counters["scans_flagged_" + text.replace(" ", "_")] += 1

    def _echoes(self, scan: ScanTelegram) -> Echoes:
        """Distance and remission of each echo sent, first echo first. Raises ProtocolError."""
        found = []
        for echo in "12":
            distance = scan.channel("DIST" + echo)
            if distance is not None and distance.step_e4deg > 0 and len(distance.values) > 0:
                found.append((distance, scan.channel("RSSI" + echo)))
        if not found:
            contents = [channel.content for channel in scan.channels_16bit + scan.channels_8bit]
            raise ProtocolError(f"a scan with channels {contents}, expected DIST1")
        if len(found[0][0].values) > self._limits.max_beams:
            raise ProtocolError(
                f"{len(found[0][0].values)} beams in a scan telegram, at most {self._limits.max_beams} are "
                f"possible for model {self._config.model}; is it another one?"
            )
        for channel in (c for pair in found for c in pair if c is not None):
            if len(channel.values) != len(found[0][0].values):
                raise ProtocolError(
                    f"channel {channel.content} has {len(channel.values)} beams, "
                    f"{found[0][0].content} has {len(found[0][0].values)}"
                )
            if not channel.makes_numbers:
                raise ProtocolError(
                    f"channel {channel.content} has scale {channel.scale:g} and offset {channel.offset:g}, "
                    "expected finite ones and a scale above 0"
                )
        return found

    def _frame(self, scan: ScanTelegram, echoes: Echoes, arrived_ns: int) -> LaserScan | None:
        geometry = echoes[0][0]
        self._clock.observe(scan.sent_us, arrived_ns)
        self._count(clock_resets=self._clock.resets)
        shift_us = self._first_beam_before_zero_us(scan, geometry)
        stamp_ns = self._clock.to_host_ns((scan.start_us - shift_us) % CLOCK_MODULUS)
        beam_interval_ns = self._beam_interval_ns(scan, geometry)
        beams = self._wanted_beams(geometry)
        if beams.start >= beams.stop:
            self.counters["scans_outside_field_of_view"] += 1
            self._silence.dropped(OUTSIDE)
            return None
        stamp_ns += beams.start * beam_interval_ns
        if not self._gate.passes(stamp_ns, arrived_ns):
            return None
        self._silence.heard()
        self._check_against_config(scan, geometry)
        step_deg = exact_step_deg(geometry.step_e4deg)
        first_deg = geometry.first_e4deg / 10_000 - 90.0 + beams.start * step_deg
        echoes = [(distance.part(beams), rssi and rssi.part(beams)) for distance, rssi in echoes]
        range_m, intensity = (
            self._last_echo(echoes) if self._config.echo == "last" else self._convert(*echoes[0])
        )
        self._count_codes(echoes[0][0].values)
        return LaserScan(
            sensor=self._config.name,
            stamp_ns=stamp_ns,
            arrived_ns=arrived_ns,
            beam_interval_ns=beam_interval_ns,
            scan_period_ns=round(1e11 / scan.frequency_chz * self._dialogue.scan_interval),
            first_angle_rad=math.radians(first_deg),
            angle_step_rad=math.radians(step_deg),
            range_min_m=self._config.range_min_m,
            range_max_m=self._config.range_max_m,
            range_m=range_m,
            intensity=intensity,
        )

    def _wanted_beams(self, geometry: Channel) -> slice:
        """The beams of the configured field of view, where the device sends more than a step beyond it."""
        wanted, count = self._dialogue.output_range, len(geometry.values)
        step_e4deg = exact_step_deg(geometry.step_e4deg) * 10_000
        before_e4deg = wanted.first_e4deg - geometry.first_e4deg
        behind_e4deg = geometry.last_e4deg - wanted.last_e4deg
        before, behind = (
            math.ceil((beyond_e4deg - ANGLE_SLACK_E4DEG) / step_e4deg)
            if beyond_e4deg > ANGLE_SLACK_E4DEG + step_e4deg
            else 0
            for beyond_e4deg in (before_e4deg, behind_e4deg)
        )
        return slice(before, count - behind)

    def _check_against_config(self, scan: ScanTelegram, geometry: Channel) -> None:
        """Raises TransportError where a device that was as configured no longer is: the next connection
        writes what differs."""
        wanted, wanted_range = self._dialogue.scan_config, self._dialogue.output_range
        found = ScanConfig(scan.frequency_chz, geometry.step_e4deg)
        found_range = OutputRange(geometry.first_e4deg, geometry.last_e4deg)
        if found.agrees(wanted) and found_range.agrees(wanted_range, slack_e4deg=wanted.step_e4deg):
            self._other_in_a_row, self._was_as_configured = 0, True
            return
        self.counters["scans_not_as_configured"] += 1
        self._other_in_a_row += 1
        found_words, set_words = _words(found, found_range), _words(wanted, wanted_range)
        beams = self._wanted_beams(geometry)
        is_cut = beams.stop - beams.start < len(geometry.values)
        self._other_scans = (
            f"{found_words}, configured {set_words}" + ", cut to these angles by the driver" * is_cut
        )
        if self._was_as_configured and self._other_in_a_row > OTHER_LIMIT:
            raise TransportError(
                f"{self._other_in_a_row} scans in a row at {found_words}, set was {set_words}; "
                "another host changed it, or it restarted"
            )

    def _beam_interval_ns(self, scan: ScanTelegram, geometry: Channel) -> int:
        """From the measurement frequency where it fits the rotation, else from the rotation."""
        by_rotation_hz = scan.frequency_chz / 100.0 * FULL_TURN_E4DEG / geometry.step_e4deg
        shots_hz = scan.shots_100hz * (1.0 if scan.shots_100hz > 10_000 else 100.0)
        if shots_hz and abs(shots_hz / by_rotation_hz - 1.0) < 0.1:
            return round(1e9 / shots_hz)
        self.counters["scans_odd_measurement_frequency"] += 1
        return round(1e9 / by_rotation_hz)

    def _first_beam_before_zero_us(self, scan: ScanTelegram, geometry: Channel) -> int:
        """Time of the first beam before the zero-index stamp, us. By the earliest sending of this
        sweep: one that is delayed gives no information, and the others scatter by 0.2 ms, which stamps shall
        not.
        """
        e4deg_per_us = scan.frequency_chz / 100.0 * FULL_TURN_E4DEG / 1e6
        begin_e4deg = self._limits.first_e4deg
        sending_us = (scan.sent_us - scan.start_us) % CLOCK_MODULUS
        sweep = (scan.frequency_chz, geometry.last_e4deg)
        if self._sweep_measured == sweep:
            sending_us = min(sending_us, self._least_sending_us)
        self._sweep_measured, self._least_sending_us = sweep, sending_us
        sweep_us = round((self._limits.last_e4deg - begin_e4deg) / e4deg_per_us)
        last_us = round((geometry.last_e4deg - begin_e4deg) / e4deg_per_us)
        start_before_zero_us = sweep_us - sending_us if sending_us < last_us else 0
        return start_before_zero_us - round((geometry.first_e4deg - begin_e4deg) / e4deg_per_us)

    def _last_echo(self, echoes: Echoes) -> Rows:
        """The second echo where there is one, else the first."""
        range_m, intensity = self._convert(*echoes[0])
        if len(echoes) == 2:
            second_m, second_intensity = self._convert(*echoes[1])
            there = ~np.isnan(second_m)
            self.counters["beams_with_second_echo"] += int(np.count_nonzero(there))
            range_m = np.where(there, second_m, range_m)
            if len(intensity) and len(second_intensity):
                intensity = np.where(there, second_intensity, intensity)
        return range_m, intensity

    @staticmethod
    def _convert(distance: Channel, remission: Channel | None) -> Rows:
        """Range in m with NaN for every code that is no distance, and intensity in device units."""
        range_m = (distance.values * (distance.scale * 1e-3) + distance.offset * 1e-3).astype(np.float32)
        low = distance.values < FIRST_RANGE_CODE
        range_m[low] = _NO_DISTANCE[distance.values[low]]
        if remission is None:
            return range_m, NO_INTENSITY
        return range_m, remission.values * np.float32(remission.scale) + np.float32(remission.offset)

    def _count_codes(self, values: npt.NDArray[np.uint16]) -> None:
        low = values[values < FIRST_RANGE_CODE]
        if len(low):
            for code, count in zip(*np.unique(low, return_counts=True), strict=True):
                self.counters["beams_" + LOW_CODES.get(int(code), "reserved_code")] += int(count)


def _words(scan: ScanConfig, part: OutputRange) -> str:
    return f"{scan.words} from {part.words}"
