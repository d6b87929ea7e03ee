"""MTData2 and legacy MTData into frames: axes, units, stamps, gaps. No I/O.

A message without a time (a unit that sends UTC alone, before its first fix) is stamped by its arrival. Where
acceleration and rate of turn have rates of their own, each of the faster is a sample, with the newest of the
other.

Inertial samples and GNSS solutions are two streams that run through one another. What is missing is counted
for each on its own: samples by SampleTimeFine, solutions by the receiver's time of week, and complete
messages by the packet counter, which counts both.
"""

import math
from collections import Counter
from datetime import UTC, datetime
from typing import TypeVar

from drivers.clock import MappedClock
from drivers.errors import ProtocolError
from drivers.frames import Frame, GnssFix, ImuSample
from drivers.watch import NOT_FINITE, SilenceWatch, StampGate
from drivers.xsens_mtig.config import XsensMtigConfig
from drivers.xsens_mtig.health import GNSS_FIX, DeviceHealth
from drivers.xsens_mtig.mtdata import LegacyCodec, LegacyData, RawGps, Settings
from drivers.xsens_mtig.mtdata2 import FRAME_MASK, KIND_MASK, GnssPvt, Kind, LocalFrame, Utc, read_item, split
from drivers.xsens_mtig.orientation import Vector, apply, axes_of, device_from_axes, to_enu
from drivers.xsens_mtig.reals import Reals
from drivers.xsens_mtig.sample_clock import FINE_TICK_NS, CounterClock, FineClock
from drivers.xsens_mtig.wanted import GNSS_HZ, LegacyOutput, OutputItems

PACKET_MODULUS = 1 << 16
GAP_IS_A_RESTART = 2_000  # messages; 10 s at 200 Hz
GNSS_PERIOD_MS = 1000 // GNSS_HZ
WEEK_MS = 604_800_000
MAX_MISSED_FIXES = 240
UTC_ALL_VALID = 0b111
LEGACY_UTC_VALID = 1
NO_ACCURACY = 0xFFFF_FFFF
USABLE_FIXES = (2, 3, 4)
MAX_PERIODS_OLD = 2.5  # of the slower of rate of turn and acceleration, where it goes with the faster one
PERIOD_SHOWS_AFTER = 20  # steps between samples
NO_PLACE = (math.nan, math.nan, math.nan)
UNKNOWN_COVARIANCE = (0.0,) * 9
T = TypeVar("T")
_Found = dict[int, tuple[int, bytes]]  # kind -> id and payload of an item
_FIX_WORDS = {True: "GNSS fix", False: "no GNSS fix", None: "not known whether there is a GNSS fix"}

_READ = frozenset(
    (
        Kind.PACKET_COUNTER,
        Kind.SAMPLE_TIME_FINE,
        Kind.UTC,
        Kind.QUATERNION,
        Kind.EULER,
        Kind.MATRIX,
        Kind.ACCELERATION,
        Kind.RATE,
        Kind.GNSS_PVT,
        Kind.STATUS_BYTE,
        Kind.STATUS_WORD,
    )
)


class _Stream:
    """Base of both protocols."""

    _clock: MappedClock

    def __init__(
        self, config: XsensMtigConfig, counters: Counter[str], health: DeviceHealth, silence: SilenceWatch
    ) -> None:
        self._config = config
        self._counters = counters
        self._health = health
        self._silence = silence  # of the inertial samples
        self._axes = axes_of(config.forward_axis, config.up_axis)
        self._device = device_from_axes(self._axes)
        self._latency_ns = round(config.latency_ms * 1e6)
        self._sample_gate = StampGate(counters, "samples", silence)
        self._fix_gate = StampGate(counters, "fixes")
        self.by_arrival = False  # the newest sample had no time
        self._sample_period_ns = 1e9 / config.rate_hz
        self._mixed = ""  # rates of acceleration and rate of turn, where they differ
        self._utc_stands = False  # it does not run before the first fix
        self._last_utc_ticks: int | None = None
        self._last_itow_ms: int | None = None

    @property
    def offset_ns(self) -> int | None:
        """Host minus device clock; None: the newest sample had no time."""
        return None if self.by_arrival else self._clock.offset_ns

    @property
    def offset_sigma_ns(self) -> int | None:
        """Standard deviation of that offset."""
        return None if self.by_arrival else self._clock.offset_sigma_ns

    @property
    def notes(self) -> list[str]:
        """Notes on the samples for the status."""
        notes = [self._mixed] if self._mixed else []
        if self.by_arrival:
            notes.append("no sample time, and no UTC before the first GNSS fix: stamped by arrival")
        return notes

    def _utc_ticks(self, utc: Utc, known: bool) -> int | None:
        """UTC in ticks of the sample time, valid or not where it runs; None where it stands or is no date."""
        second = min(utc.second, 59)  # 60 in a leap second
        try:
            moment = datetime(utc.year, utc.month, utc.day, utc.hour, utc.minute, second, tzinfo=UTC)
        except ValueError:
            return None
        unix_s = round(moment.timestamp()) + utc.second - second
        ticks = (unix_s * 1_000_000_000 + utc.nanosecond) // FINE_TICK_NS
        self._utc_stands = not known and (self._utc_stands or ticks == self._last_utc_ticks)
        self._last_utc_ticks = ticks
        return None if self._utc_stands else ticks

    def _arrival_stamp_ns(self, sent_ns: int, arrived_ns: int, messages_behind: float) -> int:
        """Stamp of a sample without a time; messages_behind: how many more came in the same read."""
        self._counters["samples_stamped_by_arrival"] += 1
        ready_ns = min(sent_ns, arrived_ns - round(messages_behind * self._sample_period_ns))
        last_ns = self._sample_gate.last_ns
        return (
            ready_ns - self._latency_ns if last_ns is None else max(ready_ns - self._latency_ns, last_ns + 1)
        )

    def _sample(
        self,
        stamp_ns: int,
        arrived_ns: int,
        rate: Reals,
        force: Reals,
        local: LocalFrame,
        orientation: Reals | None,
    ) -> list[Frame]:
        if not all(map(math.isfinite, (*rate, *force))):
            self._counters["samples_not_finite"] += 1
            self._silence.dropped(NOT_FINITE)
            return []
        if not self._sample_gate.passes(stamp_ns, arrived_ns):
            return []
        enu_from_sensor = None
        if orientation is not None and all(map(math.isfinite, orientation)):
            enu_from_sensor = to_enu(local, orientation, self._device)
        return [
            ImuSample(
                sensor=self._config.name,
                stamp_ns=stamp_ns,
                arrived_ns=arrived_ns,
                rate_radps=self._turned(rate),
                force_mps2=self._turned(force),
                orientation_wxyz=enu_from_sensor,
            )
        ]

    def _turned(self, vector: Reals) -> Vector:
        return apply(self._axes, vector)

    def _count_solution(self, itow_ms: int) -> None:
        """Count one of the receiver's, and those missing before it by its time of week."""
        self._counters["fixes_received"] += 1
        if self._last_itow_ms is not None:
            missed = (itow_ms - self._last_itow_ms) % WEEK_MS // GNSS_PERIOD_MS - 1
            if 0 < missed <= MAX_MISSED_FIXES:
                self._counters["fixes_missed"] += missed
        self._last_itow_ms = itow_ms

    def _fix(
        self,
        stamp_ns: int,
        arrived_ns: int,
        status: int,
        place: tuple[float, float, float],
        accuracy_m: tuple[float, float] | None,
    ) -> list[Frame]:
        """accuracy_m: horizontal and vertical, one sigma; None: not reported."""
        if not self._fix_gate.passes(stamp_ns, arrived_ns):
            return []
        self._counters["fixes_good" if status >= 0 else "fixes_none"] += 1
        covariance = UNKNOWN_COVARIANCE
        if status >= 0 and accuracy_m is not None:
            plane, height = accuracy_m[0] ** 2, accuracy_m[1] ** 2
            covariance = (plane, 0.0, 0.0, 0.0, plane, 0.0, 0.0, 0.0, height)
        where = place if status >= 0 else NO_PLACE
        return [GnssFix(self._config.name, stamp_ns, arrived_ns, status, *where, covariance)]


class Mtdata2Stream(_Stream):
    """One connection's MTData2, of the output that the device reports."""

    _clock: FineClock

    def __init__(
        self,
        config: XsensMtigConfig,
        counters: Counter[str],
        health: DeviceHealth,
        silence: SilenceWatch,
        output: OutputItems,
    ) -> None:
        super().__init__(config, counters, health, silence)
        rates = {identifier & KIND_MASK: rate for identifier, rate in output}
        force_hz, rate_hz = rates.get(Kind.ACCELERATION, 0), rates.get(Kind.RATE, 0)
        self._leading = Kind.ACCELERATION if force_hz > rate_hz else Kind.RATE
        if force_hz != rate_hz:
            self._mixed = (
                f"acceleration at {force_hz} Hz, rate of turn at {rate_hz} Hz: "
                "with each of the faster goes the newest of the slower"
            )
        self._sample_period_ns = 1e9 / max(force_hz, rate_hz, 1)
        self._most_old_ns = MAX_PERIODS_OLD * 1e9 / max(min(force_hz, rate_hz), 1)
        self._newest: dict[Kind, tuple[int, Reals]] = {}  # stamp and value of rate of turn and acceleration
        self._clock = FineClock(self._latency_ns)
        self._last_packet: int | None = None
        self._period_ticks = 0  # between samples; the shortest of the first steps
        self._steps = 0

    def take(self, data: bytes, sent_ns: int, arrived_ns: int, messages_behind: float) -> list[Frame]:
        """Frames of one message, which was on the line from sent_ns on; so many more came in the same read.
        Raises ProtocolError where its content is not MTData2."""
        found: _Found = {}
        for identifier, payload in split(data):
            kind = identifier & KIND_MASK
            if kind in _READ:
                found[kind] = (identifier, payload)
        packet, ticks = _read(found, Kind.PACKET_COUNTER, int), self._ticks(found)
        inertial = self._leading in found
        step = 0
        if ticks is not None:
            resets, step = self._clock.resets, self._clock.step(ticks)
            if inertial or self._clock.offset_ns is None:
                self._clock.observe(ticks, sent_ns)
            if self._clock.resets > resets:
                self._last_packet = self._last_itow_ms = None
                step = 0
                self._counters["clock_resets"] += 1
        self._count_packets(packet)
        for kind in (Kind.STATUS_WORD, Kind.STATUS_BYTE):
            if (status := _read(found, kind, int)) is not None:
                self._health.observe_status(status)
                break
        if ticks is not None:
            stamp_ns = self._clock.to_host_ns(ticks)
        elif inertial:
            stamp_ns = self._arrival_stamp_ns(sent_ns, arrived_ns, messages_behind)
        else:
            stamp_ns = sent_ns - self._latency_ns
        for kind in (Kind.RATE, Kind.ACCELERATION):
            if (value := _read(found, kind, tuple)) is not None:
                self._newest[kind] = (stamp_ns, value)
        frames: list[Frame] = []
        if inertial:
            self.by_arrival = ticks is None
            self._count_samples(step)
            frames += self._inertial(found, stamp_ns, arrived_ns)
        if (pvt := _read(found, Kind.GNSS_PVT, GnssPvt)) is not None:
            frames += self._gnss(pvt, stamp_ns, arrived_ns)
        elif not found.keys() & {Kind.UTC, Kind.RATE, Kind.ACCELERATION}:
            self._counters["messages_without_samples"] += 1
        return frames

    def _ticks(self, found: _Found) -> int | None:
        """SampleTimeFine; else UTC in ticks of the same length; None: the message has neither."""
        ticks = _read(found, Kind.SAMPLE_TIME_FINE, int)
        if ticks is not None or (utc := _read(found, Kind.UTC, Utc)) is None:
            return ticks
        return self._utc_ticks(utc, utc.valid & UTC_ALL_VALID == UTC_ALL_VALID)

    def _count_packets(self, packet: int | None) -> None:
        if packet is None:
            return
        if self._last_packet is not None:
            gap = (packet - self._last_packet) % PACKET_MODULUS
            if 1 <= gap <= GAP_IS_A_RESTART:
                self._counters["messages_missed"] += gap - 1
            else:
                self._counters["packet_counter_restarts"] += 1
        self._last_packet = packet

    def _count_samples(self, step: int) -> None:
        """Count missing samples by device time, independent of losses of the GNSS stream.

        step  in ticks since the last sample; 0: there was none
        """
        self._counters["samples_received"] += 1
        if step <= 0:
            return
        if self._steps < PERIOD_SHOWS_AFTER:
            self._steps += 1
            self._period_ticks = min(self._period_ticks or step, step)
        if step <= GAP_IS_A_RESTART * self._period_ticks:
            self._counters["samples_missed"] += max(0, round(step / self._period_ticks) - 1)

    def _inertial(self, found: _Found, stamp_ns: int, arrived_ns: int) -> list[Frame]:
        newest = [self._newest.get(kind) for kind in (Kind.RATE, Kind.ACCELERATION)]
        values = [pair[1] for pair in newest if pair is not None and stamp_ns - pair[0] <= self._most_old_ns]
        if len(values) < len(newest):
            self._counters["messages_without_samples"] += 1
            return []
        if Kind.RATE not in found or Kind.ACCELERATION not in found:
            self._counters["samples_with_the_newest_of_the_slower"] += 1
        rate, force = values
        orientation: Reals | None = None
        local = LocalFrame.ENU
        for kind in (Kind.QUATERNION, Kind.EULER, Kind.MATRIX):
            if (orientation := _read(found, kind, tuple)) is not None:
                local = _local_frame(found[kind][0])
                break
        return self._sample(stamp_ns, arrived_ns, rate, force, local, orientation)

    def _gnss(self, pvt: GnssPvt, stamp_ns: int, arrived_ns: int) -> list[Frame]:
        self._count_solution(pvt.itow_ms)
        good = bool(pvt.flags & 1)
        self._health.observe_gnss(pvt.fix, good, pvt.satellites)
        usable = pvt.fix in USABLE_FIXES and good and pvt.horizontal_accuracy_mm != NO_ACCURACY
        status = (1 if pvt.flags & 2 else 0) if usable else -1
        place = (pvt.lat_1e7deg * 1e-7, pvt.lon_1e7deg * 1e-7, pvt.height_mm * 1e-3)
        accuracy_m = (pvt.horizontal_accuracy_mm * 1e-3, pvt.vertical_accuracy_mm * 1e-3)
        return self._fix(stamp_ns, arrived_ns, status, place, accuracy_m)


def _read(found: _Found, kind: Kind, form: type[T]) -> T | None:
    """The value of this item, which is of that form; None where it was not sent. Raises ProtocolError."""
    if kind not in found:
        return None
    value = read_item(*found[kind])
    assert isinstance(value, form)
    return value


def _local_frame(identifier: int) -> LocalFrame:
    try:
        return LocalFrame(identifier & FRAME_MASK)
    except ValueError as error:
        raise ProtocolError(f"id 0x{identifier:04X}: local frame 0xC does not exist") from error


class LegacyStream(_Stream):
    """One connection's MTData, of the layout that was requested from the device or that it reports."""

    _clock: CounterClock | FineClock

    def __init__(
        self,
        config: XsensMtigConfig,
        counters: Counter[str],
        health: DeviceHealth,
        silence: SilenceWatch,
        output: LegacyOutput,
    ) -> None:
        super().__init__(config, counters, health, silence)
        self._codec = LegacyCodec(output.layout)
        self._local = output.layout.local_frame
        self._sample_period_ns = 1e9 / output.rate_hz
        if output.layout.settings & Settings.SAMPLE_COUNTER:
            self._clock = CounterClock(self._sample_period_ns, output.skip, self._latency_ns)
        else:
            self._clock = FineClock(self._latency_ns)  # by UTC
        self._samples_per_fix = max(1, round(output.rate_hz / GNSS_HZ))
        self._since_fix = 0

    def _observe(self, sample: LegacyData, sent_ns: int) -> tuple[int, int] | None:
        """Stamp of the sample, and how many are missing before it; None where it has no time."""
        if isinstance(self._clock, CounterClock):
            assert sample.sample_counter is not None
            missed = self._clock.observe(sample.sample_counter, sent_ns)
            return self._clock.to_host_ns(sample.sample_counter), missed
        ticks = (
            None if sample.utc is None else self._utc_ticks(sample.utc, sample.utc.valid == LEGACY_UTC_VALID)
        )
        if ticks is None:
            return None
        missed = max(0, round(self._clock.step(ticks) * FINE_TICK_NS / self._sample_period_ns) - 1)
        self._clock.observe(ticks, sent_ns)
        return self._clock.to_host_ns(ticks), missed

    def take(self, data: bytes, sent_ns: int, arrived_ns: int, messages_behind: float) -> list[Frame]:
        """Frames of one message, which was on the line from sent_ns on; so many more came in the same read.
        Raises ProtocolError where its length is not the layout's."""
        sample = self._codec.decode(data)
        resets = self._clock.resets
        observed = self._observe(sample, sent_ns)
        self.by_arrival = observed is None
        stamp_ns, missed = observed or (self._arrival_stamp_ns(sent_ns, arrived_ns, messages_behind), 0)
        if self._clock.resets > resets:
            self._counters["clock_resets"] += 1
            self._last_itow_ms = None
        elif missed < GAP_IS_A_RESTART:
            self._counters["samples_missed"] += missed
        self._counters["samples_received"] += 1
        if sample.status is not None:
            self._health.observe_status(sample.status)
        frames: list[Frame] = []
        if sample.rate_radps is not None and sample.acceleration_mps2 is not None:
            frames += self._sample(
                stamp_ns,
                arrived_ns,
                sample.rate_radps,
                sample.acceleration_mps2,
                self._local,
                sample.orientation,
            )
        else:
            self._counters["messages_without_samples"] += 1
        return frames + self._position(sample, stamp_ns, arrived_ns)

    def _position(self, sample: LegacyData, stamp_ns: int, arrived_ns: int) -> list[Frame]:
        if sample.raw_gps is None and sample.position is None:
            return []
        has_fix = None if sample.status is None else bool(sample.status & GNSS_FIX)
        self._health.observe_gnss_words(_FIX_WORDS[has_fix])
        if sample.raw_gps is not None:
            return self._receiver(sample.raw_gps, has_fix, stamp_ns, arrived_ns)
        assert sample.position is not None
        self._since_fix += 1
        if self._since_fix < self._samples_per_fix:
            return []
        self._since_fix = 0
        self._counters["fixes_received"] += 1
        if has_fix is None:
            self._counters["fixes_without_status"] += 1
            return []
        latitude, longitude, height = sample.position
        usable = has_fix and all(map(math.isfinite, sample.position))
        place = (latitude, longitude, height)
        return self._fix(stamp_ns, arrived_ns, 0 if usable else -1, place, None)

    def _receiver(self, gps: RawGps, has_fix: bool | None, stamp_ns: int, arrived_ns: int) -> list[Frame]:
        """The receiver's own solution, repeated in every message until there is a new one.

        has_fix   None: the unit sends no status, which alone shows it
        """
        if gps.itow_ms == self._last_itow_ms:
            return []
        self._count_solution(gps.itow_ms)
        if has_fix is None:
            self._counters["fixes_without_status"] += 1
            return []
        age_ns = gps.age * self._sample_period_ns
        accuracy_m = (gps.horizontal_accuracy_mm * 1e-3, gps.vertical_accuracy_mm * 1e-3)
        usable = has_fix and gps.horizontal_accuracy_mm not in (0, NO_ACCURACY)
        place = (gps.lat_1e7deg * 1e-7, gps.lon_1e7deg * 1e-7, gps.height_mm * 1e-3)
        status = 0 if usable else -1
        return self._fix(stamp_ns - round(age_ns), arrived_ns, status, place, accuracy_m)
