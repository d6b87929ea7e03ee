"""Time of a stream frame, from counting frames: they carry no time but come every 15 ms.

The count is the device's clock for a ClockMap. What this adds to it: frames that were lost must not make the
clock late, and a robot whose period is not 15.0 ms must not make it drift.
"""

from collections import deque

from drivers.clock import ClockMap, MappedClock
from drivers.irobot_create.protocol import FRAME_PERIOD_NS

# Frames whose fastest one is taken as prompt: longer than the bunches of 80 ms that USB makes, and than the
# beat between the 16 ms of an FTDI adapter's timer and our 15 ms, 16 frames.
WINDOW = 16
# (frames, least flow, least step), the latter two in periods: if the floor of lateness rose by the step,
# and these frames took that long to arrive, so that no queue is being emptied, then frames were lost.
LOSS_SIGNS = ((4, 2.5, 6.0), (WINDOW, 10.0, 0.75))
BLOCK = 16  # frames per point of the period's measurement
MAX_BLOCKS = 64
RETUNE_SHARE = ((32, 250e-6), (5, 0.01))  # (blocks measured, deviation worth a new period)
EVEN_SHARE = 0.5  # how far the single slopes may differ; lost frames are steps, a wrong period is a slope
MAX_DEVIATION = 0.05  # 64.5 frames a second were measured on a Roomba 690, 3 per cent off


class FrameClock(MappedClock):
    """Give it each good frame in order; it answers with the frame's stamp on the host's clock. The
    frame clock is count times period.

    latency_ns  from the moment of measurement to the arrival of the last byte, at the fastest: the frame's
                time on the wire, plus what a calibration found
    """

    def __init__(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self.period_ns = float(FRAME_PERIOD_NS)
        self.frames_missed = 0
        self.retunes = 0
        self._last_stamp_ns: int | None = None
        self.restart()

    def restart(self) -> None:
        """The robot's count began again: after a reset, or when a stream was requested again."""
        self._count = 0
        self._origin: tuple[int, int] | None = None  # (count, arrived_ns) that lateness is measured from
        self._clock = ClockMap(self.period_ns, latency_ns=self._latency_ns)
        self._recent: deque[tuple[int, int]] = deque(maxlen=2 * WINDOW)  # (arrived_ns, lateness_ns)
        # (count, lateness_ns) of the promptest.
        self._blocks: deque[tuple[int, int]] = deque(maxlen=MAX_BLOCKS)
        self._block: list[tuple[int, int]] = []  # (lateness_ns, count)

    def stamp(self, arrived_ns: int, missing_at_most: int) -> int:
        """Stamp, ns, of the next frame; later than that of every frame before it.

        arrived_ns       when its own last byte came, host clock
        missing_at_most  how many frames the damaged bytes before it can have been
        """
        self._count += 1
        if self._origin is None:
            self._origin = (self._count, arrived_ns)
        lateness_ns = self._lateness(arrived_ns)
        if missing_at_most and self._recent:
            floor_ns = min(lateness for _, lateness in list(self._recent)[-WINDOW:])
            missing = round((lateness_ns - floor_ns) / self.period_ns)
            lateness_ns = self._count_missing(min(max(missing, 0), missing_at_most), lateness_ns)
        self._recent.append((arrived_ns, lateness_ns))
        if missing := self._steps_up():
            lateness_ns = self._count_missing(missing, lateness_ns)
        self._measure_period(lateness_ns)
        self._clock.observe(self._count, arrived_ns)
        stamp_ns = self._clock.to_host_ns(self._count)
        if self._last_stamp_ns is not None:
            stamp_ns = max(stamp_ns, self._last_stamp_ns + 1)
        self._last_stamp_ns = stamp_ns
        return stamp_ns

    def _lateness(self, arrived_ns: int) -> int:
        assert self._origin is not None
        count, origin_ns = self._origin
        return arrived_ns - origin_ns - round((self._count - count) * self.period_ns)

    def _count_missing(self, missing: int, lateness_ns: int) -> int:
        self._count += missing
        self.frames_missed += missing
        return lateness_ns - round(missing * self.period_ns)

    def _steps_up(self) -> int:
        """Frames lost without a trace: the lateness of all recent ones is up by integer periods, and
        stays.
        """
        recent = list(self._recent)
        for frames, flow, step in LOSS_SIGNS:
            before, now = recent[-WINDOW - frames : -frames], recent[-frames:]
            if len(before) < WINDOW or now[-1][0] - now[0][0] < flow * self.period_ns:
                continue
            step_ns = min(lateness for _, lateness in now) - min(lateness for _, lateness in before)
            if step_ns >= step * self.period_ns:
                missing = round(step_ns / self.period_ns)
                shift_ns = round(missing * self.period_ns)
                self._recent.extend([(arrived, lateness - shift_ns) for arrived, lateness in now])
                self._block = []
                return missing
        return 0

    def _measure_period(self, lateness_ns: int) -> None:
        """Every BLOCK frames: retune if the promptest frames of newer blocks creep off the older ones."""
        self._block.append((lateness_ns, self._count))
        if len(self._block) < BLOCK:
            return
        lateness_ns, count = min(self._block)
        self._blocks.append((count, lateness_ns))
        self._block = []
        threshold = next((share for blocks, share in RETUNE_SHARE if len(self._blocks) >= blocks), None)
        if threshold is None:
            return
        points = list(self._blocks)
        creeps_ns = sorted(  # per frame
            (late_ns - early_ns) / (late_count - early_count)
            for (early_count, early_ns), (late_count, late_ns) in zip(
                points, points[len(points) // 2 :], strict=False
            )
        )
        creep_ns = creeps_ns[len(creeps_ns) // 2]
        even = creeps_ns[-1] - creeps_ns[0] <= EVEN_SHARE * abs(creep_ns)
        possible = abs((self.period_ns + creep_ns) / FRAME_PERIOD_NS - 1.0) <= MAX_DEVIATION
        if even and possible and abs(creep_ns) > threshold * self.period_ns:
            self._retune(creep_ns, points[-1])

    def _retune(self, creep_ns: float, prompt: tuple[int, int]) -> None:
        assert self._origin is not None
        prompt_count, prompt_lateness_ns = prompt
        origin_count, origin_ns = self._origin
        elapsed_ns = round((prompt_count - origin_count) * self.period_ns)
        count = self._count
        self.period_ns += creep_ns
        self.retunes += 1
        self.restart()
        self._count = count
        self._origin = (prompt_count, origin_ns + elapsed_ns + prompt_lateness_ns)
        self._clock.observe(*self._origin)
