"""Device clock -> host clock, from one-way arrivals.

A message can only be late, never early, so in the plane (device time, arrival - device time) every
message lies on or above the true line offset + skew * t, and the lower convex hull of the messages hugs it.
Source: Zhang, Liu, Xia, "Clock synchronization algorithms for network measurements", INFOCOM 2002.
The shortest delay that occurs remains, a constant; `latency_ms` of a driver's config subtracts it.
"""

from dataclasses import dataclass, field

JUMP_NS = 500_000_000  # further from the prediction than jitter goes
BACKLOG_NS = 2_000_000_000  # a network that delayed messages has delivered them by then
SETTLED_NS = 2_000_000_000  # a hull shorter than this does not determine skew
WINDOW_NS = 60_000_000_000  # a hull is used from half this age to this age, so warming-up drift is followed
UNKNOWN_NS = 1_000_000_000  # standard deviation of an offset that rests on one message
MAX_SKEW = 300e-6  # crystals are good to 100 ppm; more is a hull over bad data
# A hull this long with more skew than that is begun again, lest its offset grow stale.
RUNAWAY_NS = 10_000_000_000
MAX_RUNAWAY = 0.01  # no oscillator is worse: a sender that falls behind is
MAX_BEND = 0.25  # of the clocks' difference: how far messages may lie from their line


@dataclass(slots=True)
class _Hull:
    """Lower convex hull of (device ns, offset ns), both relative to the first point, so exact in floats."""

    device0_ns: int
    offset0_ns: int
    points: list[tuple[float, float]] = field(default_factory=list)
    minimum_offset_ns: float = 0.0
    count: int = 0  # of messages
    sum_device_ns: float = 0.0
    sum_offset_ns: float = 0.0

    def add(self, device_ns: int, offset_ns: int) -> None:
        x, y = float(device_ns - self.device0_ns), float(offset_ns - self.offset0_ns)
        points = self.points
        self.minimum_offset_ns = min(self.minimum_offset_ns, y)
        self.count += 1
        self.sum_device_ns += x
        self.sum_offset_ns += y
        if points and x <= points[-1][0]:
            if y < points[-1][1]:
                points[-1] = (points[-1][0], y)
            return
        while len(points) >= 2:
            (x0, y0), (x1, y1) = points[-2], points[-1]
            if (y1 - y0) * (x - x0) < (y - y0) * (x1 - x0):
                break
            points.pop()
        points.append((x, y))

    @property
    def span_ns(self) -> float:
        return self.points[-1][0] if self.points else 0.0

    def line(self) -> tuple[float, float] | None:
        """Offset at device0_ns (relative to offset0_ns) and skew of the supporting line below all points.

        It is the edge over the middle of the time covered, which minimises the summed distance. None where
        that edge is steeper than any crystal; a short hull is flat, at the fastest arrival.
        """
        if self.span_ns < SETTLED_NS or len(self.points) < 2:
            return self.minimum_offset_ns, 0.0
        middle = self.span_ns / 2.0
        right = next(i for i, (x, _) in enumerate(self.points) if x >= middle)
        (x0, y0), (x1, y1) = self.points[max(right - 1, 0)], self.points[max(right, 1)]
        skew = (y1 - y0) / (x1 - x0)
        return None if abs(skew) > MAX_SKEW else (y0 - skew * x0, skew)

    @property
    def is_straight(self) -> bool:
        """Whether the messages lie along one line: clocks that drift, not a sender that falls behind."""
        (x0, y0), (x1, y1) = self.points[0], self.points[-1]
        skew, most_ns = (y1 - y0) / (x1 - x0), MAX_BEND * abs(y1 - y0)
        below_ns = max(y0 + skew * (x - x0) - y for x, y in self.points)
        middle_ns = self.sum_device_ns / self.count
        above_ns = self.sum_offset_ns / self.count - (y0 + skew * (middle_ns - x0))
        return abs(skew) <= MAX_RUNAWAY and below_ns <= most_ns and above_ns <= most_ns


class ClockMap:
    """Learns the device's clock from arrivals and translates ticks to host nanoseconds.

    tick_ns       length of a tick, ns
    wrap_ticks    the counter's modulus (2**32 for a 32-bit counter), or None where it never wraps
    latency_ns    shortest delay from the moment of measurement to arrival, if known by calibration

    `observe` first, with the ticks of the moment the message left; then `to_host_ns` for any tick near it.
    Messages delayed by a network come late for a while and change nothing, and a sender that falls behind
    bit by bit comes late for as long as it does. A message far too early, ticks that go back by more than
    JUMP_NS or stay behind, or lateness that came with one message and does not end, are a restart of the
    device: all is learnt again. A single message from a little before the newest is out of order, and changes
    nothing.
    """

    def __init__(self, tick_ns: float, wrap_ticks: int | None = None, latency_ns: int = 0) -> None:
        self._tick_ns = tick_ns
        self._wrap_ticks = wrap_ticks
        self._latency_ns = latency_ns
        self._last_ticks: int | None = None  # unwrapped, the furthest so far
        self._back_ticks: int | None = None  # unwrapped, of a message before those
        self._hull: _Hull | None = None
        self._young: _Hull | None = None
        self._line = (0.0, 0.0)
        self._late_since_ns: int | None = None
        self.resets = 0
        self.runaways = 0  # hulls begun again because the clocks drift faster than crystals do
        self.residual_ns = 0  # how much later than the line the newest message came

    @property
    def offset_sigma_ns(self) -> int:
        """Standard deviation of the fastest arrival; UNKNOWN_NS for the first message.

        Lateness l_1 .. l_n is taken as exponential: the least of n lies mean(l) / n above its bound, and
        scatters by as much (Johnson, Kotz, Balakrishnan, Continuous Univariate Distributions 1, 1994, 19.7).
        """
        hull = self._hull
        if hull is None or hull.count < 2:
            return UNKNOWN_NS
        lateness_ns = hull.sum_offset_ns / hull.count - hull.minimum_offset_ns
        return min(round(lateness_ns / hull.count), UNKNOWN_NS)

    @property
    def skew_ppm(self) -> float:
        """How much slower the device's clock runs than the host's, parts per million."""
        return self._line[1] * 1e6

    @property
    def offset_ns(self) -> int | None:
        """Host minus device clock at the newest message; None before the first."""
        if self._last_ticks is None:
            return None
        return self._translate(self._last_ticks) - round(self._last_ticks * self._tick_ns)

    def observe(self, ticks: int, arrived_ns: int) -> None:
        """Take in that a message that left at `ticks` arrived at `arrived_ns`."""
        unwrapped = self._unwrap(ticks)
        device_ns = round(unwrapped * self._tick_ns)
        if self._hull is not None and self._restarted(unwrapped, arrived_ns):
            self._hull = self._young = self._late_since_ns = None
            self.resets += 1
        elif self._last_ticks is not None and unwrapped < self._last_ticks:
            self._back_ticks = unwrapped
            self.residual_ns = arrived_ns - self._translate(unwrapped)
            return
        self._last_ticks, self._back_ticks = unwrapped, None
        offset_ns = arrived_ns - device_ns
        if self._hull is None:
            self._hull = _Hull(device_ns, offset_ns)
        elif self._young is None:
            if self._hull.span_ns > WINDOW_NS / 2:
                self._young = _Hull(device_ns, offset_ns)
        elif self._young.span_ns > WINDOW_NS / 2:
            if self._lateness_of(self._young) <= MAX_SKEW * WINDOW_NS:  # more is no drift, but lateness
                self._hull = self._young
            self._young = None
        for hull in (self._hull, self._young):
            if hull is not None:
                hull.add(device_ns, offset_ns)
        line = self._hull.line()
        if line is None and self._hull.span_ns > RUNAWAY_NS and self._hull.is_straight:
            self._hull, self._young = _Hull(device_ns, offset_ns), None
            self._hull.add(device_ns, offset_ns)
            self.runaways += 1
        skew = self._line[1]
        self._line = line or (min(y - skew * x for x, y in self._hull.points), skew)
        self.residual_ns = arrived_ns - self._translate(unwrapped)

    def _lateness_of(self, young: _Hull) -> float:
        """Delay of its fastest message behind the line, ns."""
        hull = self._hull
        assert hull is not None
        offset, skew = self._line
        expected = hull.offset0_ns + offset + skew * (young.device0_ns - hull.device0_ns)
        return young.offset0_ns + young.minimum_offset_ns - expected

    def _restarted(self, unwrapped_ticks: int, arrived_ns: int) -> bool:
        late_ns = arrived_ns - self._translate(unwrapped_ticks)
        if late_ns < -JUMP_NS:
            return True
        back = self._last_ticks is not None and unwrapped_ticks < self._last_ticks
        if back and self._back_ticks is not None and unwrapped_ticks > self._back_ticks:
            return True
        if late_ns <= JUMP_NS:
            self._late_since_ns = None
            return False
        if back:
            return True
        if self._late_since_ns is None:
            if late_ns - self.residual_ns <= JUMP_NS:
                return False  # its messages are as far apart as before: it lags, its clock has not moved
            self._late_since_ns = arrived_ns
        return arrived_ns - self._late_since_ns > BACKLOG_NS

    def to_host_ns(self, ticks: int) -> int:
        """Host time of `ticks`, which lie within half a wrap of the newest message observed."""
        if self._hull is None:
            raise ValueError("no message observed yet: call observe() first")
        return self._translate(self._unwrap(ticks)) - self._latency_ns

    def _unwrap(self, ticks: int) -> int:
        if self._last_ticks is None or self._wrap_ticks is None:
            return ticks
        half = self._wrap_ticks // 2
        return self._last_ticks + (ticks - self._last_ticks + half) % self._wrap_ticks - half

    def _translate(self, unwrapped_ticks: int) -> int:
        hull = self._hull
        assert hull is not None
        device_ns = round(unwrapped_ticks * self._tick_ns)
        offset, skew = self._line
        return device_ns + hull.offset0_ns + round(offset + skew * (device_ns - hull.device0_ns))


class MappedClock:
    """Base of a device's own kind of time: what it says of the ClockMap under it."""

    _clock: ClockMap

    @property
    def offset_ns(self) -> int | None:
        """Host minus device clock; None before the first message."""
        return self._clock.offset_ns

    @property
    def offset_sigma_ns(self) -> int:
        """Standard deviation of that offset."""
        return self._clock.offset_sigma_ns

    @property
    def resets(self) -> int:
        """Number of restarts of the device's clock."""
        return self._clock.resets
