"""A fake MTi-G (MTData) or MTi-G-710 (MTData2): messages in and out, fed by an InertialSource.

Sources: MT0101P; answers of real units in ethz-asl/ethzasl_xsens_driver issues 55 and 66, recordings of an
MTi-G-710 in einride/xsens-go. Timing is real: samples on the grid of the device's own clock, a byte on the
line takes its time, and an answer waits behind the data in transit.
"""

import struct
from collections import Counter, deque
from dataclasses import dataclass, field
from functools import cache
from typing import Literal

import numpy as np

from drivers.xsens_mtig.mtdata import Layout, LegacyCodec
from drivers.xsens_mtig.mtdata2 import EVERY_MESSAGE, Kind
from drivers.xsens_mtig.protocol import TIMER_OVERFLOW, Message, MessageDecoder, Mid, encode
from simulators.device import CATCH_UP_NS, TURNS_SKIPPED, turns_to_skip
from simulators.inertial import Inertial, InertialSource, Place
from simulators.xsens_mtig_data import (
    GNSS_OFF_NS,
    Sample,
    UtcBeforeFix,
    gnss_message,
    inertial_message,
    legacy_message,
)
from simulators.xsens_mtig_settings import DeviceSettings, Refusal

Personality = Literal["mtdata2", "legacy"]

BATCH = 20  # samples fetched from the truth at a time
WAKE_UP_WINDOW_NS = 500_000_000
GNSS_PERIOD_NS = 250_000_000
FINE_TICK_NS = 100_000
MAX_LAG_NS = 300_000_000  # of the line; later data overflow the device's buffer
FILTER_SETTLES_NS = 600_000_000
ANY_STATE = (
    Mid.GO_TO_CONFIG,
    Mid.RESET,
    Mid.WAKE_UP_ACK,
    Mid.RESET_ORIENTATION,
    Mid.GPS_STATUS,
    Mid.REQ_DATA,
)


@cache
def _legacy_codec(mode: int, settings: int) -> LegacyCodec:
    return LegacyCodec(Layout(mode, settings))


@dataclass(frozen=True, slots=True)
class MtigSetup:
    """Build and stored state of this unit.

    latency_ns       from the moment of a sample to its first byte on the line
    gnss_latency_ns  from the receiver's measurement to the first byte of its message
    counts_skipped   its sample counter counts the samples it skips as well
    boot_ns          from power-on or Reset to WakeUp
    product          its product code, "" for that of an MTi-G or MTi-G-710; others have no receiver
    fixed            ids of messages whose settings it refuses
    unsendable       kinds of MTData2 that it refuses to send
    utc_before_fix   what it sends for UTC before its first fix: the time it guesses, nothing (an MTi-G: no
                     date), no date, always the same
    start_ticks      SampleTimeFine when the fake world began; it is 0 after every reset
    """

    personality: Personality = "mtdata2"
    baud: int | None = 115_200  # None: over USB
    clock_drift_ppm: float = 0.0
    start_ticks: int = 40_000
    fine_modulus: int = 864_000_000
    start_count: int = 0  # packet counter, sample counter
    counts_skipped: bool = False
    latency_ns: int = 1_000_000
    gnss_latency_ns: int = 45_000_000
    boot_ns: int = 800_000_000
    utc_at_start_ns: int = 1_547_992_044_000_000_000
    product: str = ""
    fixed: frozenset[int] = frozenset()
    unsendable: frozenset[int] = frozenset()
    utc_before_fix: UtcBeforeFix = "runs"


@dataclass(slots=True)
class _Clock:
    """The device's clock, in ns since it was reset."""

    zero_ns: int  # host time of device time 0
    rate: float

    def device_ns(self, host_ns: int) -> int:
        return round((host_ns - self.zero_ns) * self.rate)

    def host_ns(self, device_ns: int) -> int:
        return self.zero_ns + round(device_ns / self.rate)


@dataclass(slots=True)
class FakeMtiG:
    """One unit on one line. It has been on, and measuring by its settings, since the world began.

    ignores_go_to_config  it ignores GoToConfig until it is reset, as recorded of one by USB
    settings              its flash, which tests read and write
    """

    source: InertialSource
    setup: MtigSetup = MtigSetup()
    ignores_go_to_config: bool = False
    state: Literal["off", "booting", "config", "measurement"] = "measurement"
    counters: Counter[str] = field(default_factory=Counter)
    received: deque[int] = field(default_factory=lambda: deque(maxlen=1000))  # message ids
    settings: DeviceSettings = field(init=False)
    _decoder: MessageDecoder = field(default_factory=MessageDecoder)
    _line: deque[tuple[int, bytes]] = field(default_factory=deque)  # (last byte has left, message)
    _line_free_ns: int = 0
    _clock: _Clock | None = None  # None: not read yet
    _start_ticks: int = 0
    _count: int = 0  # packet counter, or sample counter
    _next_sample: int = 0  # index on the device's grid
    _next_fix_ns: int = 0  # host time of the receiver's next measurement
    _wake_at_ns: int | None = None
    _boot_ends_ns: int | None = None
    _batch: tuple[int, Inertial, list[Place] | None] | None = None  # index of its first sample
    _place: Place | None = None
    _place_utc_ns: int = 0
    _place_index: int = 0
    _lose: int = 0
    clipped: int = 0  # bits 8 to 16 of the status word, from now on

    def __post_init__(self) -> None:
        s = self.setup
        self.settings = DeviceSettings(s.personality, s.baud, s.product, s.fixed, s.unsendable)
        self._start_ticks = self.setup.start_ticks
        self._count = self.setup.start_count

    def restart(self, now_ns: int) -> None:
        """Power fails and comes back: silence for boot_ns, then WakeUp; every counter begins at 0."""
        self._begin(now_ns)
        self._line.clear()
        self._line_free_ns = now_ns
        self._decoder = MessageDecoder()
        self.settings.power_up()
        self._clock = _Clock(now_ns, self._rate)
        self._start_ticks = self._count = 0
        self.state, self.ignores_go_to_config = "off", False
        self._wake_at_ns = now_ns + self.setup.boot_ns
        self._boot_ends_ns = self._place = None
        self._batch = None

    def send_error(self, code: int, now_ns: int) -> None:
        self._put(encode(Mid.ERROR, bytes((code,))), now_ns)

    def send_warning(self, code: int, text: str, now_ns: int) -> None:
        self._put(encode(Mid.WARNING, struct.pack(">I", code) + text.encode("ascii")), now_ns)

    def lose_messages(self, count: int) -> None:
        """The next data messages are not sent; their counter goes on."""
        self._lose += count

    def jump_clock(self, seconds: float) -> None:
        """SampleTimeFine, or the sample counter, jumps."""
        self._start_ticks += round(seconds * 1e9 / FINE_TICK_NS)
        self._count += round(seconds * 1e9 / self._period_ns) if self.settings.legacy else 0

    def spoil_checksum(self, message: bytes) -> bytes:
        return message[:-1] + bytes((message[-1] ^ 0x55,)) if message[:1] == b"\xfa" else message

    def connected(self, now_ns: int) -> bytes:
        self._begin(now_ns)
        self._line.clear()  # data without a client are lost
        self._line_free_ns = min(self._line_free_ns, now_ns)
        self._skip(now_ns, 0)
        return b""

    def disconnected(self, now_ns: int) -> None:
        """Nothing changes."""

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        self._begin(now_ns)
        self._measure(now_ns)
        for message in self._decoder.receive_data(data):
            self.received.append(message.mid)
            if self.state != "off":
                self._obey(message, now_ns)
        return b""

    def next_due_ns(self, now_ns: int) -> int | None:
        if self._line:
            return self._line[0][0]
        times = [self._wake_at_ns, self._boot_ends_ns]
        if self.state == "measurement" and self._clock is not None:
            times += [self._sample_ready_ns(), self._fix_ready_ns()]
        return min([due_ns for due_ns in times if due_ns is not None], default=None)

    def due(self, now_ns: int) -> bytes:
        self._begin(now_ns)
        if self._wake_at_ns is not None and now_ns >= self._wake_at_ns:
            self.state, self._boot_ends_ns = "booting", self._wake_at_ns + WAKE_UP_WINDOW_NS
            self._put(encode(Mid.WAKE_UP), self._wake_at_ns)
            self._wake_at_ns = None
        if self._boot_ends_ns is not None and now_ns >= self._boot_ends_ns:
            self._put(encode(Mid.CONFIGURATION, self.settings.configuration()), self._boot_ends_ns)
            self._start_measuring(self._boot_ends_ns)
        self._measure(now_ns)
        if self._line and self._line[0][0] <= now_ns:
            return self._line.popleft()[1]
        return b""

    def _begin(self, now_ns: int) -> None:
        if self._clock is None:
            self._clock = _Clock(now_ns, self._rate)
            self._line_free_ns = now_ns
            self._start_measuring(now_ns)

    @property
    def _rate(self) -> float:
        return 1.0 + self.setup.clock_drift_ppm * 1e-6

    def _put(self, message: bytes, ready_ns: int) -> None:
        """After the data in transit."""
        baud = self.settings.baud
        begin_ns = max(ready_ns, self._line_free_ns)
        self._line_free_ns = begin_ns + (0 if baud is None else round(len(message) * 10e9 / baud))
        self._line.append((self._line_free_ns, message))

    def _start_measuring(self, now_ns: int) -> None:
        assert self._clock is not None
        self.state, self._boot_ends_ns = "measurement", None
        self._next_sample = self._clock.device_ns(now_ns) // self._period_ns + 1
        self._next_fix_ns = self._full_fix_ns(now_ns)
        self._place_index = self._next_sample
        self._batch = None

    @property
    def _period_ns(self) -> int:
        """Of the messages, on the device's clock."""
        return self.settings.period_ns

    @property
    def _counts_a_message(self) -> int:
        return self.settings.skip + 1 if self.setup.counts_skipped else 1

    def _sample_ready_ns(self) -> int | None:
        if not self.settings.sends_data:
            return None
        return self._host_ns(self._next_sample) + self.setup.latency_ns

    def _fix_ready_ns(self) -> int | None:
        return self._next_fix_ns + self.setup.gnss_latency_ns if self.settings.receives_gnss else None

    def _host_ns(self, index: int) -> int:
        assert self._clock is not None
        return self._clock.host_ns(index * self.settings.period_ns)

    def _full_fix_ns(self, host_ns: int) -> int:
        """Host time of the next full 250 ms of UTC, where the receiver measures; a little beside it."""
        utc_ns = self._utc_ns(host_ns)
        return host_ns + (-utc_ns) % GNSS_PERIOD_NS + GNSS_PERIOD_NS + GNSS_OFF_NS

    def _utc_ns(self, host_ns: int) -> int:
        return self.setup.utc_at_start_ns + host_ns

    def _skip(self, now_ns: int, keep_ns: int) -> int:
        """Leave out data older than that, though samples are counted on the wire; returns their number."""
        if self.state != "measurement" or self._clock is None:
            return 0
        skipped = turns_to_skip(now_ns - self._host_ns(self._next_sample), self._period_ns, keep_ns)
        self._count += skipped * self._counts_a_message
        self._next_sample += skipped
        if now_ns - self._next_fix_ns > keep_ns + GNSS_PERIOD_NS:
            self._next_fix_ns = self._full_fix_ns(now_ns - keep_ns)
        return skipped

    def _measure(self, now_ns: int) -> None:
        """Put all data that are ready by now on the line."""
        if skipped := self._skip(now_ns, CATCH_UP_NS):
            self.counters[TURNS_SKIPPED] += skipped
        while self.state == "measurement":
            sample_ns, fix_ns = self._sample_ready_ns(), self._fix_ready_ns()
            ready_ns = min([t for t in (sample_ns, fix_ns) if t is not None], default=None)
            if ready_ns is None or ready_ns > now_ns:
                return
            if ready_ns == sample_ns:
                self._emit(self._next_message(), ready_ns)
                self._next_sample += 1
            else:
                self._take_fix(ready_ns)

    def _next_message(self) -> bytes:
        index = self._next_sample
        count, self._count = self._count, self._count + self._counts_a_message
        samples, estimates, row = self._sampled(index)
        estimate = None if self._place is None or estimates is None else estimates[row]
        sample = self._sample(self._host_ns(index), count, samples, row, estimate)
        if self.settings.legacy:
            codec = _legacy_codec(self.settings.mode, self.settings.output_settings)
            age = index - self._place_index
            data = legacy_message(codec, sample, count & 0xFFFF, age, self._place_utc_ns)
            return encode(Mid.MTDATA, data)
        return encode(Mid.MTDATA2, inertial_message(self.settings.items_at(index), sample))

    def _take_fix(self, ready_ns: int) -> None:
        """An MTi-G keeps the solution for its next samples, an MTi-G-710 sends it in a message of its own."""
        at_ns = self._next_fix_ns
        self._place, self._place_utc_ns = self.source.place(at_ns), self._utc_ns(at_ns)
        self._place_index = self._next_sample
        self._next_fix_ns += GNSS_PERIOD_NS
        identifiers = [identifier for identifier, _ in self.settings.output]
        if self.settings.legacy or Kind.GNSS_PVT not in identifiers:
            return
        samples = Inertial(np.zeros((1, 3)), np.zeros((1, 3)), np.eye(3)[np.newaxis])
        sample = self._sample(at_ns, self._count, samples, 0, None)
        self._count += 1
        every = [i for i, rate in self.settings.output if rate == EVERY_MESSAGE]
        self._emit(encode(Mid.MTDATA2, gnss_message(every, sample)), ready_ns)

    def _sampled(self, index: int) -> tuple[Inertial, list[Place] | None, int]:
        """A batch of samples, the filter's solutions, and the row of this sample."""
        if self._batch is None or not 0 <= index - self._batch[0] < BATCH:
            stamps_ns = np.array([self._host_ns(index + i) for i in range(BATCH)], dtype=np.int64)
            self._batch = (index, self.source.inertial(stamps_ns), self.source.estimates(stamps_ns))
        first, samples, estimates = self._batch
        return samples, estimates, index - first

    def _sample(
        self, host_ns: int, count: int, samples: Inertial, row: int, estimate: Place | None
    ) -> Sample:
        assert self._clock is not None
        device_ns = self._clock.device_ns(host_ns)
        return Sample(
            ticks=(self._start_ticks + device_ns // FINE_TICK_NS) % self.setup.fine_modulus,
            packet=count & 0xFFFF,
            utc_ns=self._utc_ns(host_ns),
            utc_known=self._place is not None,
            utc_before_fix=self.setup.utc_before_fix,
            rate_radps=samples.rate_radps[row],
            force_mps2=samples.force_mps2[row],
            enu_from_sensor=samples.enu_from_sensor[row],
            filter_valid=device_ns + self._start_ticks * FINE_TICK_NS >= FILTER_SETTLES_NS,
            clipped=self.clipped,
            period_s=self._period_ns * 1e-9,
            place=self._place,
            estimate=estimate,
        )

    def _emit(self, message: bytes, ready_ns: int) -> None:
        if self._lose:
            self._lose -= 1
            return
        if self._line_free_ns - ready_ns > MAX_LAG_NS:
            self.counters["messages_overflowed"] += 1
            if self.counters["messages_overflowed"] % 100 == 1:
                self._put(encode(Mid.ERROR, bytes((TIMER_OVERFLOW,))), ready_ns)
            return
        self._put(message, ready_ns)

    def _obey(self, message: Message, now_ns: int) -> None:
        mid = message.mid
        if mid == Mid.WAKE_UP_ACK:
            if self.state == "booting":
                self.state, self._boot_ends_ns = "config", None
            return
        if mid == Mid.GO_TO_CONFIG and self.ignores_go_to_config:
            return
        try:
            if self.state != "config" and mid not in ANY_STATE:
                raise Refusal
            data = self._act(message, now_ns)
        except Refusal as refusal:
            self._put(encode(Mid.ERROR, bytes((refusal.code,)), message.bus_id), now_ns)
            return
        if data is not None:
            self._put(encode(mid + 1, data, message.bus_id), now_ns)
        if mid == Mid.GO_TO_MEASUREMENT:
            self._start_measuring(now_ns)
        if mid == Mid.RESET:
            self._reset(now_ns)

    def _act(self, message: Message, now_ns: int) -> bytes | None:
        """Data of the acknowledgement, None where there is none. Raises Refusal."""
        match message.mid:
            case Mid.GO_TO_CONFIG:
                self.state, self._boot_ends_ns = "config", None
                return b""
            case Mid.GO_TO_MEASUREMENT | Mid.RESET:
                return b""
            case Mid.REQ_DATA:
                if not self.settings.legacy or self.state != "measurement":
                    raise Refusal
                self._next_sample = max(
                    self._next_sample, self._clock.device_ns(now_ns) // self._period_ns if self._clock else 0
                )
                self._emit(self._next_message(), now_ns)
                return None
        return self.settings.answer(message)

    def _reset(self, now_ns: int) -> None:
        """The acknowledgement still goes out at the old rate."""
        last = self._line.pop()
        self.restart(now_ns)
        self._line.append(last)
