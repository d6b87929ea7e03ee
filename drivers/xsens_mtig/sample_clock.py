"""Time of a sample on the host's clock: from SampleTimeFine, from UTC, or by counting samples.

SampleTimeFine counts 0.1 ms and wraps after a day (864 000 000, MTi-G-700/710) or at 2^32 (later devices);
which one it is shows when it wraps. GNSS messages carry the time of the receiver's measurement, some 45 ms
before the samples around them, so small steps back are no restart. UTC in the same ticks serves as well.
"""

from drivers.clock import ClockMap, MappedClock

FINE_TICK_NS = 100_000
FINE_MODULI = (864_000_000, 1 << 32)
MAX_BACK_TICKS = 10_000  # 1 s
MAX_AHEAD_TICKS = 600_000  # over a wrap; 1 min without a message is a dead link anyway
COUNTER_MODULUS = 1 << 16


class FineClock(MappedClock):
    """SampleTimeFine to host time; `observe` first, then `to_host_ns` for the same or a near reading."""

    def __init__(self, latency_ns: int) -> None:
        self._clock = ClockMap(FINE_TICK_NS, latency_ns=latency_ns)
        self._last: int | None = None  # as read
        self._wraps_ticks = 0  # what all wraps so far amount to

    def step(self, ticks: int) -> int:
        """From the last reading observed to this one; negative: it lies before, or the device restarted."""
        return 0 if self._last is None else self._unwrapped(ticks) - self._wraps_ticks - self._last

    def observe(self, ticks: int, sent_ns: int) -> None:
        """The message of a sample taken at `ticks` was completely on the wire at sent_ns of the host."""
        unwrapped = self._unwrapped(ticks)
        self._clock.observe(unwrapped, sent_ns)
        self._wraps_ticks, self._last = unwrapped - ticks, ticks

    def to_host_ns(self, ticks: int) -> int:
        return self._clock.to_host_ns(self._unwrapped(ticks))

    def _unwrapped(self, ticks: int) -> int:
        if self._last is None:
            return ticks
        step = ticks - self._last
        if -MAX_BACK_TICKS <= step <= MAX_AHEAD_TICKS:
            return self._wraps_ticks + ticks
        for modulus in FINE_MODULI:
            for turned in (step + modulus, step - modulus):  # over the wrap, or back over it
                if -MAX_BACK_TICKS <= turned <= MAX_AHEAD_TICKS:
                    return self._wraps_ticks + self._last + turned
        return self._wraps_ticks + ticks


class CounterClock(MappedClock):
    """A 16-bit sample counter to host time, for devices that send no other.

    period_ns  of one message. Some firmware counts the samples it skips as well: `skip` of them between two
               messages; the first step that is seen decides, and a smaller one later.
    """

    def __init__(self, period_ns: float, skip: int, latency_ns: int) -> None:
        self._period_ns = period_ns
        self._skip = skip
        self._latency_ns = latency_ns
        self._stride: int | None = None  # counts from one message to the next
        self._last: int | None = None
        self._new_clock(1)
        self._resets = 0

    def _new_clock(self, stride: int) -> None:
        self._clock = ClockMap(self._period_ns / stride, COUNTER_MODULUS, self._latency_ns)

    @property
    def resets(self) -> int:
        return self._resets + self._clock.resets

    def observe(self, count: int, sent_ns: int) -> int:
        """As FineClock.observe; returns how many messages are missing since the last, modulo a wrap."""
        missing = 0
        if self._last is not None:
            step = (count - self._last) % COUNTER_MODULUS
            self._learn_stride(step)
            missing = max(0, round(step / (self._stride or 1)) - 1)
        self._last = count
        self._clock.observe(count, sent_ns)
        return missing

    def _learn_stride(self, step: int) -> None:
        stride = 1 if not self._skip or step % (self._skip + 1) else self._skip + 1
        if self._stride is None or stride < self._stride:
            if stride != (self._stride or 1):
                self._resets += self._clock.resets
                self._new_clock(stride)
            self._stride = stride

    def to_host_ns(self, count: int) -> int:
        return self._clock.to_host_ns(count)
