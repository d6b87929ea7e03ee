"""Begin of a sweep on the host's clock, finer than the device's milliseconds.

Three things are known of a sweep: its stamp, cut to integer milliseconds; that the mirror turns evenly; that
it arrived some time after it was complete, never before. Call "ideal arrival" the moment stamped plus the
shortest delay that ever occurs. A ClockMap over stamps and arrivals gives a line that lies below it by less
than a millisecond, the arrival itself lies above. Over some seconds of sweeps, counted by revolutions, the
line that touches all these upper bounds from below is tight wherever the milliseconds roll over or the wire
is prompt.

The delay itself: what TM1 answered at the start bounds its clock from both sides (Cristian 1989), and
the stamps give in which millisecond each sweep began, so together they bound the delay.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.clock import ClockMap, MappedClock
from drivers.hokuyo_utm30lx.protocol import CLOCK_MODULUS

TICK_NS = 1_000_000
WINDOW_NS = 4_800_000_000  # shorter than a motor's speed wanders, long enough for prompt arrivals
LINE_AFTER_NS = 1_500_000_000  # a shorter window determines the period too little
PERIOD_KNOWN_AFTER_NS = 3_600_000_000  # kept over a restart of the device's clock
FIT_EVERY = 8  # scans
MAX_DELAY_OFF_NS = 50_000_000  # from the nominal delay: two scans may be in transit
NEAR_SYNC_MS = 1_000  # of the stream's beginning: so long no crystal drifts far from what TM1 answered

Stamps = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TimeSample:
    """One TM1: sent not before, answered with this time of the device, answer read not after. Host ns."""

    requested_ns: int
    device_ms: int
    answered_ns: int


def since_ms(ticks: int, earlier: int) -> int:
    """From one reading of the device's clock to another less than half a wrap away, signed."""
    half = CLOCK_MODULUS // 2
    return (ticks - earlier + half) % CLOCK_MODULUS - half


def bounds_of_time(samples: Sequence[TimeSample]) -> tuple[int, int] | None:
    """Between which host times, ns, the device's clock came to the first sample's millisecond; None without
    samples or where they contradict each other. A clock of integer milliseconds runs up to one ahead.
    """
    if not samples:
        return None
    since_ns = [since_ms(sample.device_ms, samples[0].device_ms) * TICK_NS for sample in samples]
    lowest = max(
        sample.requested_ns - since - TICK_NS for sample, since in zip(samples, since_ns, strict=True)
    )
    highest = min(sample.answered_ns - since for sample, since in zip(samples, since_ns, strict=True))
    return (lowest, highest) if lowest < highest else None


class ScanClock(MappedClock):
    """Give it each scan in order; it answers with the moment of the device's stamp.

    period_ns   from one scan of the stream to the next, nominal
    delay_ns    from the moment stamped to arrival, at the fastest, as far as known without TM1
    """

    def __init__(self, period_ns: float, delay_ns: int) -> None:
        self.period_ns = period_ns  # as measured, once that can be done
        self.delay_ns = delay_ns  # within what TM1 allows, once measured
        self.contradictions = 0  # of TM1 with itself, or with the scans: then the delay stays as it is
        self.too_close = 0  # stamps within half a sweep behind another
        self._most_delay_ns = delay_ns + MAX_DELAY_OFF_NS
        self._clock = ClockMap(TICK_NS, CLOCK_MODULUS)
        self._sync: tuple[int, int, int] | None = None  # device ms, bounds of its host time
        self._window: deque[tuple[int, int, int]] = deque()  # sweep, stamp in ms, arrived_ns; two unwrapped
        self._since_fit = 0
        self._line: tuple[int, int] | None = None  # sweep and its ideal arrival; period_ns is the slope
        self._period_known = False

    @property
    def offset_ns(self) -> int | None:
        """Host minus device clock; None before the first scan."""
        offset_ns = self._clock.offset_ns
        return None if offset_ns is None else offset_ns - self.delay_ns

    def synchronise(self, samples: Sequence[TimeSample]) -> bool:
        """Take in what TM1 answered; False where it contradicts itself."""
        bounds = bounds_of_time(samples)
        if bounds is None:
            self.contradictions += 1
            return False
        self._sync = (samples[0].device_ms, *bounds)
        return True

    def stamp(self, device_ms: int, arrived_ns: int) -> int:
        """Host time, ns, of what the device stamped device_ms (modulo 2**24). A stamp from before the newest,
        or within half a sweep behind it, where the mirror cannot be again, does not constrain the line."""
        resets = self._clock.resets
        self._clock.observe(device_ms, arrived_ns)
        if self._clock.resets > resets:
            self._window.clear()
            self._line = self._sync = None
        if not self._append(device_ms, arrived_ns):
            return self._clock.to_host_ns(device_ms) - self.delay_ns
        self._since_fit += 1
        if self._since_fit >= FIT_EVERY or self._line is None:
            self._fit()
        return self._ideal_arrival_ns() - self.delay_ns

    def _append(self, device_ms: int, arrived_ns: int) -> bool:
        """Whether it is a sweep after the newest."""
        window = self._window
        if not window:
            window.append((0, device_ms, arrived_ns))
            return True
        sweep, before_ms, _ = window[-1]
        elapsed_ms = since_ms(device_ms, before_ms % CLOCK_MODULUS)
        sweeps = round(elapsed_ms * TICK_NS / self.period_ns)
        if sweeps < 1:
            self.too_close += elapsed_ms >= 0
            return False
        window.append((sweep + sweeps, before_ms + elapsed_ms, arrived_ns))
        while (window[-1][1] - window[0][1]) * TICK_NS > WINDOW_NS:
            window.popleft()
            self._sync = None  # the scans near it are gone; from now on the delay stays
        return True

    def _ideal_arrival_ns(self) -> int:
        """Ideal arrival of the newest scan: the line, within the bounds of its stamp and arrival."""
        sweep, stamp_ms, arrived_ns = self._window[-1]
        lowest = self._clock.to_host_ns(stamp_ms % CLOCK_MODULUS)
        highest = min(lowest + TICK_NS, arrived_ns)
        if self._line is None:
            return (lowest + highest) // 2
        line_sweep, line_ns = self._line
        return min(max(line_ns + round((sweep - line_sweep) * self.period_ns), lowest), highest)

    def _fit(self) -> None:
        """Fit the line again, then update the delay."""
        self._since_fit = 0
        sweep, stamp_ms, arrived_ns = np.array(self._window, dtype=np.int64).T
        span_ns = int(stamp_ms[-1] - stamp_ms[0]) * TICK_NS
        slope_shows = span_ns >= (PERIOD_KNOWN_AFTER_NS if self._period_known else LINE_AFTER_NS)
        if not slope_shows and not self._period_known:
            return
        lowest_ns = self._by_clock_map(stamp_ms)
        highest_ns = np.minimum(lowest_ns + TICK_NS, arrived_ns)
        if slope_shows:
            left, right = _edge_below(sweep, highest_ns)
            self.period_ns = float(highest_ns[right] - highest_ns[left]) / float(sweep[right] - sweep[left])
            self._period_known |= span_ns >= PERIOD_KNOWN_AFTER_NS
        else:
            left = int(np.argmin(highest_ns - sweep * self.period_ns))
        self._line = (int(sweep[left]), int(highest_ns[left]))
        if slope_shows and self._sync is not None:
            ideal_ns = highest_ns[left] + ((sweep - sweep[left]) * self.period_ns).astype(np.int64)
            near = stamp_ms - stamp_ms[0] < NEAR_SYNC_MS
            self._bound_delay(stamp_ms[near], ideal_ns[near])

    def _by_clock_map(self, stamp_ms: Stamps) -> Stamps:
        """(N,) ideal arrival of sweeps stamped so at the stroke of the millisecond."""
        first, last = int(stamp_ms[0]), int(stamp_ms[-1])
        first_ns, last_ns = (self._clock.to_host_ns(ms % CLOCK_MODULUS) for ms in (first, last))
        slope_ns = (last_ns - first_ns) / max(last - first, 1)
        return first_ns + ((stamp_ms - first) * slope_ns).astype(np.int64)

    def _bound_delay(self, stamp_ms: Stamps, ideal_ns: Stamps) -> None:
        """A sweep began in the millisecond of its stamp, and TM1 answered when that was. No scan is stamped
        behind its arrival, nor are many in transit: then the clock was set since TM1."""
        assert self._sync is not None
        device_ms, earliest_ns, latest_ns = self._sync
        elapsed_ms = stamp_ms - stamp_ms[0] + since_ms(int(stamp_ms[0]) % CLOCK_MODULUS, device_ms)
        elapsed_ns = (elapsed_ms * (TICK_NS * (1.0 + self._clock.skew_ppm * 1e-6))).astype(np.int64)
        lowest = int((ideal_ns - elapsed_ns).max()) - TICK_NS - latest_ns
        highest = int((ideal_ns - elapsed_ns).min()) - earliest_ns
        delay_ns = (lowest + highest) // 2
        if lowest < highest and 0 <= delay_ns <= self._most_delay_ns:
            self.delay_ns = delay_ns
        else:
            self.contradictions += 1
            self._sync = None


def _edge_below(x: Stamps, y: Stamps) -> tuple[int, int]:
    """Ends of that edge of the points' lower convex hull which spans the mean of x: of all lines below the
    points the one with the least sum of distances. x (N,) ascending, y (N,); indices into both.
    """
    middle = float(x.mean())
    # Keeps products exact.
    flat = y - y[0] - (x - x[0]) * ((int(y[-1]) - int(y[0])) / (int(x[-1]) - int(x[0])))
    hull: list[int] = []
    xs, ys = (x - x[0]).tolist(), flat.tolist()
    for i in range(len(xs)):
        while len(hull) >= 2:
            a, b = hull[-2], hull[-1]
            if (ys[b] - ys[a]) * (xs[i] - xs[a]) < (ys[i] - ys[a]) * (xs[b] - xs[a]):
                break
            hull.pop()
        hull.append(i)
    right = next(i for i, index in enumerate(hull) if int(x[index]) >= middle)
    return hull[max(right - 1, 0)], hull[max(right, 1)]
