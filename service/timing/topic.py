"""The times of one topic, message by message."""

from collections import Counter, deque
from dataclasses import replace
from itertools import pairwise
from typing import Literal

from drivers.counted import counted
from drivers.frames import Frame, ImuSample, LaserScan, OdometrySample
from service.timing.delays import (
    COPY_SHARE,
    MAX_AHEAD_NS,
    MAX_LATENCY_NS,
    SAME_DELAY_NS,
    SHORTEST_DELAY_NS,
    Clock,
    clock_of,
    is_ordinary,
)
from service.timing.sweep_time import (
    BELIEVED,
    SweepTime,
    agree_by_themselves,
    are_same,
    judge,
    sweep_ns,
    turn_s,
)
from service.timing.turn_lag import TurnLag
from service.timing.words import seconds, share

NEW_CLOCK = 10  # messages in a row whose delay has changed by the same: then the clock was set
FASTEST_FADES_NS = 5_000_000  # a message
FARTHEST_AHEAD_NS = 1_000_000_000  # that a clock may drift to: then it counts as set
MAX_STEP_NS = 60_000_000_000  # between stamps of one drive, where log times give nothing
PERIOD_SCANS = 20  # by which the period of scans is known well
COARSE_NS = 1_000_000_000
MIN_SAME, MAX_SAME = 5, 0.3  # messages with the stamp of the one before, and their share, of coarse stamps
CERTAIN, MAX_ODD = 5, 0.4  # messages, and the share of them that single odd stamps may be
MAX_DROPPED = 0.05  # of a topic's messages; more is a warning
PACE_MESSAGES = 20  # at the beginning and at the end, by whose fastest delays a drift is known
MAX_DRIFT_NS = 200_000_000
EVEN_STEPS, EVEN = 10, 0.2  # log times from message to message, and by which share of them they differ
MAX_USUAL_DELAY_NS = 250_000_000  # of the fastest messages, to the log
MIN_LAG_S, LAG_SIGMAS = 0.045, 5.0  # by the rates of turn; less the motion model finds by itself

FAR, LATE, SAME = "with a stamp far from those around it", "out of order", "with the stamp of the one before"
NO_CLOCK, EARLY = "of a topic that is left out", "long before the first scan"


class Topic:
    """`look` at its messages until `settle`; then `judged` gives each with the times that are used of it.

    source     of its stamps; "none": it is left out
    shift_ns   added to its stamps
    findings   what is wrong with it, a sentence each
    """

    def __init__(self, name: str, is_scan: bool) -> None:
        self.name = name
        self.is_scan = is_scan
        self.is_settled = False
        self.source: Literal["stamp", "log", "none"] = "stamp"
        self.shift_ns = 0
        self.messages = 0
        self.dropped: Counter[str] = Counter()
        self.findings: list[str] = []
        self.first_ns: int | None = None  # log time of its first message, and of its newest
        self.newest_ns = 0
        self._looked: list[tuple[int, int]] = []  # stamp and log time
        self._odd = 0  # of them, with a delay out of the ordinary
        self._is_coarse = True  # by all stamps so far
        self._scan: LaserScan | None = None  # the first, by whose fields the others are judged
        self._sweep = BELIEVED
        self._turns = TurnLag()
        self._turn_rad = 0.0  # integral of a gyro's rates
        self._has_lag = False
        self._other_sweeps = 0  # scans whose fields contradict those of the others
        self._same = 0  # messages with the stamp of the one before that are no copies of it
        self._steps_ns: list[int] = []  # from scan to scan, at the beginning
        self._stamp_ns: int | None = None  # of the newest that was used, its log time and its delay
        self._log_ns = self._delay_ns = 0
        self._fastest_ns = 0  # delay of late
        self._newest_log_ns = 0  # of the newest that was judged
        self._strange: list[tuple[int, int, int]] = []  # the same of those in a row that were not
        self._sets: list[int] = []  # by how much its clock was set
        self._log_steps_ns: deque[int] = deque(maxlen=EVEN_STEPS)  # log time from message to message
        self._first_delays: list[int] = []
        self._last_delays: deque[int] = deque(maxlen=PACE_MESSAGES)

    @property
    def is_doubtful(self) -> bool:
        """Whether more of its messages have to be seen before one is used."""
        if self._scan is not None and not agree_by_themselves(self._scan):
            return True
        has_odd = self._odd > (MAX_ODD * len(self._looked) if len(self._looked) >= CERTAIN else 0)
        return self._is_coarse or has_odd

    @property
    def waiting(self) -> int:
        return len(self._looked)

    @property
    def clock(self) -> Clock:
        """By the messages that wait."""
        stamps, logs = zip(*self._looked, strict=True)
        return clock_of(stamps, logs)

    @property
    def middle_stamp_ns(self) -> int:
        """Of the messages that wait."""
        return sorted(self._looked)[len(self._looked) // 2][0]

    @property
    def sweep_ns(self) -> int:
        """From the first beam of its scans to the last, as far as that is believed; else 0."""
        if self._scan is None or not (self.is_settled or agree_by_themselves(self._scan)):
            return 0
        return sweep_ns(self._sweep.used(self._scan))

    def look(self, frame: Frame) -> None:
        """At a message that waits."""
        self._note(frame)
        if isinstance(frame, LaserScan):
            self._scan = self._scan or frame
        self._odd += not is_ordinary(frame.arrived_ns - frame.stamp_ns)
        self._is_coarse &= frame.stamp_ns % COARSE_NS == 0
        self._looked.append((frame.stamp_ns, frame.arrived_ns))

    def forget(self) -> int:
        """The messages that wait are dropped; how many they are."""
        count = len(self._looked)
        self.dropped[EARLY] += count
        self._looked.clear()
        self._odd, self._is_coarse = 0, True
        return count

    def settle(self) -> None:
        """No message waits any more."""
        if self._scan is not None and not agree_by_themselves(self._scan):
            times = sorted(looked[self.source == "log"] for looked in self._looked)
            self._judge_sweep([b - a for a, b in pairwise(times)])
        self._looked.clear()
        self.is_settled = True

    def judged(self, frame: Frame, log_offset_ns: int | None, has_waited: bool) -> Frame | str:
        """The frame with the times that are used, or why it is dropped.

        log_offset_ns  log times less this are on the clock of all stamps; None: they give nothing
        """
        if not has_waited:
            self._note(frame)
        log_ns = frame.arrived_ns - (log_offset_ns or 0)
        self._log_steps_ns.append(log_ns - self._newest_log_ns)
        used = self._with_times(frame, log_offset_ns)
        self._newest_log_ns = log_ns
        if isinstance(used, str):
            self.dropped[used] += 1
        return used

    def take_heading(self, stamp_ns: int, heading_rad: float, scans: str) -> None:
        """Where a scan of another topic lay; NaN: nowhere. Its turns may show an offset to the stamps.

        Where log times have shown an offset, it is refined. Stamps that keep to the log are used as they are.
        """
        lag = self._turns.add_scan(stamp_ns, heading_rad)
        if lag is None or self._has_lag or abs(lag.lag_s) < max(MIN_LAG_S, LAG_SIGMAS * lag.sigma_s):
            return
        self._has_lag = True
        used = "they are used as they are"
        if self.shift_ns:
            self.shift_ns -= round(lag.lag_s * 1e9)
            self._turns.forget_samples()
            used = "they are corrected by that, too"
        side = "ahead of" if lag.lag_s > 0 else "behind"
        self.findings.append(
            f"its stamps are {abs(lag.lag_s):.3f} s {side} those of {scans} by the rates of turn in "
            f"{counted(lag.scans, 'scan')} (uncertainty {lag.sigma_s:.3f} s); {used}. Is a clock wrong, or a "
            "latency? corridor calibrate measures them"
        )

    def warnings(self, least_messages: int) -> list[str]:
        """Of a topic with so many messages also the share that was dropped."""
        lines = list(self.findings)
        if self._other_sweeps:
            lines.append(
                f"{counted(self._other_sweeps, 'scan')} with a time_increment that contradicts that of the "
                f"others; for them a turn in {turn_s(self._scan) if self._scan else 0.0:.4g} s is used"
            )
        if self._sets:
            lines.append(
                f"its clock was set {counted(len(self._sets), 'time')}, first by {seconds(-self._sets[0])}, "
                f"by {seconds(-sum(self._sets))} in all; its stamps go on as before"
            )
        if (drift_ns := self._drift_ns) is not None and abs(drift_ns) > MAX_DRIFT_NS:
            pace = "slower" if drift_ns > 0 else "faster"
            lines.append(
                f"its stamps run {pace} than the log, by {seconds(abs(drift_ns))} since the beginning; they "
                "are used. Is its clock right, or is its link too slow?"
            )
        if (delay_ns := self._least_delay_ns) is not None and delay_ns > MAX_USUAL_DELAY_NS:
            lines.append(
                f"its messages come at least {seconds(delay_ns)} after their stamps by the log; the stamps "
                "are used as they are. Is its clock behind, or its link slow?"
            )
        count = self.dropped.total()
        if self.messages >= least_messages and count > MAX_DROPPED * self.messages:
            causes = ", ".join(f"{n} {cause}" for cause, n in self.dropped.most_common())
            lines.append(f"{share(count, self.messages)} messages are dropped: {causes}")
        return [f"{self.name}: {line}" for line in lines]

    def _note(self, frame: Frame) -> None:
        self.messages += 1
        self.first_ns = frame.arrived_ns if self.first_ns is None else self.first_ns
        self.newest_ns = frame.arrived_ns

    def _with_times(self, frame: Frame, log_offset_ns: int | None) -> Frame | str:
        if self.source == "none":
            return NO_CLOCK
        if self.source == "stamp" and not self._is_near(frame, log_offset_ns):
            return FAR
        log_ns = frame.arrived_ns - (log_offset_ns or 0)
        stamp_ns = (
            frame.stamp_ns + self.shift_ns
            if self.source == "stamp"
            else log_ns - self.sweep_ns - SHORTEST_DELAY_NS
        )
        last_ns = self._stamp_ns
        if stamp_ns == last_ns and log_offset_ns is not None and self._is_too_coarse(log_ns):
            stamp_ns = log_ns - self.sweep_ns - SHORTEST_DELAY_NS
        if last_ns is not None and stamp_ns <= last_ns:
            return SAME if stamp_ns == last_ns else LATE
        self._stamp_ns, self._log_ns = stamp_ns, log_ns
        if isinstance(frame, LaserScan):
            frame = self._with_sweep(frame, None if last_ns is None else stamp_ns - last_ns)
        elif isinstance(frame, OdometrySample):
            self._turns.add_sample(stamp_ns, frame.theta_rad)
        elif isinstance(frame, ImuSample):
            self._turn_rad += 0.0 if last_ns is None else frame.rate_radps[2] * (stamp_ns - last_ns) * 1e-9
            self._turns.add_sample(stamp_ns, self._turn_rad)
        return frame if stamp_ns == frame.stamp_ns else replace(frame, stamp_ns=stamp_ns)

    def _is_too_coarse(self, log_ns: int) -> bool:
        """After a message with the stamp of the one before: whether log times serve from here on."""
        assert self.first_ns is not None
        usual_ns = (self.newest_ns - self.first_ns) / self.messages
        self._same += log_ns - self._newest_log_ns > COPY_SHARE * usual_ns
        if self._same < MIN_SAME or self._same <= MAX_SAME * self.messages:
            return False
        self.source = "log"
        self.findings.append(
            f"{self._same} of {self.messages} messages have the stamp of the one before; from there on their "
            "log times are used instead. Does its driver cut header.stamp?"
        )
        return True

    def _is_near(self, frame: Frame, log_offset_ns: int | None) -> bool:
        """Whether the stamp is near those around it; once those after it agree with it, they are."""
        stamp_ns = frame.stamp_ns + self.shift_ns
        if log_offset_ns is None:
            log_ns = stamp_ns if self._stamp_ns is None else self._stamp_ns
            is_near = abs(log_ns - stamp_ns) <= MAX_STEP_NS
        else:
            log_ns = frame.arrived_ns - log_offset_ns
            ahead_ns = max(min(self._fastest_ns - MAX_AHEAD_NS, 0), -FARTHEST_AHEAD_NS)
            is_near = ahead_ns <= log_ns - stamp_ns <= max(self._delay_ns, 0) + MAX_LATENCY_NS
        delay_ns = log_ns - stamp_ns
        is_set_right = self.shift_ns and log_offset_ns is not None and is_ordinary(delay_ns + self.shift_ns)
        if not is_near and is_set_right:
            self._sets.append(-self.shift_ns)
            delay_ns += self.shift_ns
            self.shift_ns = 0
        elif not is_near:
            if self._strange and abs(delay_ns - self._strange[-1][2]) > SAME_DELAY_NS:
                self._strange.clear()
            self._strange.append((stamp_ns, log_ns, delay_ns))
            if len(self._strange) < NEW_CLOCK:
                return False
            delay_ns = self._take_clock(delay_ns, log_offset_ns)
        elif log_offset_ns is not None and self._was_set(delay_ns):
            delay_ns = self._go_on(delay_ns)
        self._strange.clear()
        self._delay_ns = delay_ns
        self._fastest_ns = min(delay_ns, self._fastest_ns + FASTEST_FADES_NS)
        if log_offset_ns is not None:
            self._last_delays.append(delay_ns)
            if len(self._first_delays) < PACE_MESSAGES:
                self._first_delays.append(delay_ns)
        return True

    def _take_clock(self, delay_ns: int, log_offset_ns: int | None) -> int:
        """Believe a clock that was set: its stamps go on as before. The delay from there on.

        Where stamps go on by themselves the log is late, and nothing is changed.
        """
        stamp_ns, log_ns, _ = self._strange[0]
        is_late = self._stamp_ns is not None and 0 < stamp_ns - self._stamp_ns <= log_ns - self._log_ns
        if log_offset_ns is None:
            self._stamp_ns = None
            return 0
        if is_late:
            return delay_ns
        return self._go_on(delay_ns)

    def _go_on(self, delay_ns: int) -> int:
        """Its stamps go on as before, though the delay is another now. The delay from there on."""
        change_ns = delay_ns - self._delay_ns
        self.shift_ns += change_ns
        self._sets.append(change_ns)
        return self._delay_ns

    def _was_set(self, delay_ns: int) -> bool:
        """Whether its clock was set before this message: those before came evenly and equally late, and so
        did this one. One that is late comes unevenly; after a stall each comes less late than the one before.
        """
        steps, delays = self._log_steps_ns, list(self._last_delays)[-EVEN_STEPS:]
        if abs(delay_ns - self._delay_ns) <= MAX_AHEAD_NS or len(delays) < EVEN_STEPS:
            return False
        return max(max(steps) - min(steps), max(delays) - min(delays)) <= EVEN * max(steps)

    @property
    def _drift_ns(self) -> int | None:
        if len(self._first_delays) < PACE_MESSAGES or self.messages < 2 * PACE_MESSAGES:
            return None
        return min(self._last_delays) - min(self._first_delays)

    @property
    def _least_delay_ns(self) -> int | None:
        """Of scans, after the sweep; None: its stamps are corrected, or it has too few messages."""
        if self.shift_ns or self._drift_ns is None:
            return None
        return min(*self._first_delays, *self._last_delays) - self.sweep_ns

    def _with_sweep(self, scan: LaserScan, step_ns: int | None) -> LaserScan:
        first = self._scan = self._scan or scan
        if step_ns is not None and len(self._steps_ns) < PERIOD_SCANS:
            self._steps_ns.append(step_ns)
            if len(self._steps_ns) == PERIOD_SCANS and self._sweep is BELIEVED:
                self._judge_sweep(self._steps_ns)
        if self._sweep is not BELIEVED or _have_same_sweep(scan, first):
            return self._sweep.used(scan)
        if agree_by_themselves(scan):
            self._scan = scan
            return scan
        self._other_sweeps += 1
        return SweepTime(turn_s(first)).used(scan)

    def _judge_sweep(self, steps_ns: list[int]) -> None:
        assert self._scan is not None
        period_s = sorted(steps_ns)[len(steps_ns) // 2] * 1e-9 if len(steps_ns) >= 2 else None
        self._sweep = judge(self._scan, period_s if period_s else None)
        if self._sweep.finding:
            self.findings.append(self._sweep.finding)


def _have_same_sweep(scan: LaserScan, other: LaserScan) -> bool:
    if scan.beam_interval_ns == other.beam_interval_ns and scan.angle_step_rad == other.angle_step_rad:
        return True
    return are_same(turn_s(scan), turn_s(other))
