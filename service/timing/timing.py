"""Frames in the order of their arrival -> frames to map, with the times that are used of them."""

from collections import Counter
from collections.abc import Collection, Mapping
from typing import NamedTuple

from drivers.counted import counted
from drivers.frames import Frame, GnssFix, ImuSample, LaserScan, OdometrySample
from service.timing.delays import MAX_LATENCY_NS, MIN_MESSAGES, Clock, is_ordinary
from service.timing.topic import CERTAIN, EARLY, FAR, LATE, MAX_STEP_NS, NO_CLOCK, SAME, Topic
from service.timing.words import seconds

WAIT_NS = 1_000_000_000  # log time from the first scan, in which doubtful topics are looked at
MAX_WAIT_NS = 5_000_000_000  # ... where they have few messages
MAX_WAITING = 5_000  # frames after the first scan: log times may stand still
MAX_SAMPLES = 200_000  # before the first scan
LONG_BEFORE_NS = 5_000_000_000  # the first scan: then a topic has ended
MIN_MESSAGES_LIVE = 100  # of a topic, before the share that is dropped is a warning

KINDS: dict[type[Frame], str] = {LaserScan: "scan", ImuSample: "imu", OdometrySample: "odom", GnssFix: "fix"}
_COUNTED = {
    (True, FAR): "scans_dropped_stamp",
    (True, LATE): "scans_dropped_late",
    (True, SAME): "scans_dropped_late",
    (False, FAR): "samples_dropped_stamp",
    (False, LATE): "samples_dropped_late",
    (False, SAME): "samples_dropped_same_stamp",
    (False, NO_CLOCK): "samples_dropped_clock",
    (False, EARLY): "samples_dropped_waiting",
}


class Timed(NamedTuple):
    """A frame with the times that are used of it."""

    frame: Frame
    is_mapped: bool  # as it was given


class _Waiting(NamedTuple):
    topic: Topic
    frame: Frame
    is_mapped: bool


class Timing:
    """Same frames in, same frames out. Log times (`arrived_ns`) never fall.

    Samples wait for the first scan. If then all topics are as they should be, which one message each tells,
    everything goes on at once; else all frames wait for WAIT_NS, live as in a replay. A topic that begins
    later waits alone.

    lasers    whose scans are mapped; those of others pass
    names     (kind, sensor) -> topic, for people; left out: /<sensor>/<kind>
    counters  where what is dropped is counted, by kind
    """

    def __init__(
        self,
        lasers: Collection[str],
        counters: Counter[str],
        names: Mapping[tuple[str, str], str] | None = None,
    ) -> None:
        self._lasers = frozenset(lasers)
        self._counters = counters
        self._names = names or {}
        self._topics: dict[tuple[str, str], Topic] = {}
        self._waiting: list[_Waiting] = []
        self._first_scan: LaserScan | None = None
        self._last_scan_ns = 0  # log time
        self._has_begun = False
        self._log_offset_ns: int | None = 0
        self._is_finished = False
        self._reference: str | None = None  # the laser whose scans show turns to the other topics

    def take(self, frame: Frame, is_mapped: bool = True) -> list[Timed]:
        """The next frame -> frames to map now, in their order."""
        if isinstance(frame, LaserScan):
            if frame.sensor not in self._lasers:
                return [Timed(frame, is_mapped)]
            self._last_scan_ns = frame.arrived_ns
        topic = self._topic_of(frame)
        if topic.is_settled:
            return self._judged(_Waiting(topic, frame, is_mapped), has_waited=False)
        topic.look(frame)
        self._waiting.append(_Waiting(topic, frame, is_mapped))
        if self._has_begun:
            return self._settled([topic]) if self._is_known(topic, frame.arrived_ns) else []
        if self._first_scan is None and isinstance(frame, LaserScan):
            self._first_scan = frame
        if self._first_scan is None:
            self._forget_oldest()
            return []
        return self._begun() if self._can_begin(self._first_scan, frame.arrived_ns) else []

    def finish(self) -> list[Timed]:
        """Nothing more comes: frames that wait still."""
        self._is_finished = True
        if not self._has_begun and self._first_scan is not None:
            return self._begun()
        late = [topic for topic in self._topics.values() if topic.waiting]
        released = self._settled([topic for topic in late if self._has_begun])
        for topic in late:
            self._forget(topic)
        return released

    @property
    def warnings(self) -> list[str]:
        """A sentence each, by topic."""
        least = 1 if self._is_finished else MIN_MESSAGES_LIVE
        lines = [line for topic in self._topics.values() for line in topic.warnings(least)]
        if self._is_finished and self._has_begun:
            lines += [
                f"{topic.name}: all {topic.messages} messages came after the last scan and are not used; "
                "are their log times right?"
                for topic in self._topics.values()
                if topic.first_ns is not None and topic.first_ns > self._last_scan_ns
            ]
        return lines

    def mapped(self, scan: LaserScan, stamp_ns: int, heading_rad: float) -> None:
        """Where a scan that was given lies: at this stamp with this heading; NaN: nowhere that is known."""
        if self._reference is None:
            self._reference = scan.sensor
        if scan.sensor != self._reference:
            return
        scans = self._topic_of(scan).name
        for topic in self._topics.values():
            if not topic.is_scan and topic.is_settled:
                topic.take_heading(stamp_ns, heading_rad, scans)

    def count_unmapped(self, frame: Frame, cause: str) -> None:
        """A frame that was given, and was not used in the end; the cause as in "5 out of order"."""
        self._topic_of(frame).dropped[cause] += 1

    def _topic_of(self, frame: Frame) -> Topic:
        key = KINDS[type(frame)], frame.sensor
        topic = self._topics.get(key)
        if topic is None:
            name = self._names.get(key, f"/{frame.sensor}/{key[0]}")
            topic = self._topics[key] = Topic(name, isinstance(frame, LaserScan))
        return topic

    def _can_begin(self, first: LaserScan, now_ns: int) -> bool:
        doubtful = [topic for topic in self._topics.values() if topic.is_doubtful]
        waited_ns = now_ns - first.arrived_ns
        if not doubtful or waited_ns >= MAX_WAIT_NS or len(self._waiting) >= MAX_WAITING:
            return True
        return waited_ns >= WAIT_NS and all(topic.waiting >= CERTAIN for topic in doubtful)

    def _is_known(self, topic: Topic, now_ns: int) -> bool:
        """Whether a topic that began later has shown what its stamps are worth."""
        if not topic.is_doubtful:
            return True
        first_ns = next(one.frame.arrived_ns for one in self._waiting if one.topic is topic)
        return now_ns - first_ns >= WAIT_NS and topic.waiting >= CERTAIN

    def _begun(self) -> list[Timed]:
        assert self._first_scan is not None
        self._has_begun = True
        for topic in self._topics.values():
            if topic.newest_ns < self._first_scan.arrived_ns - LONG_BEFORE_NS:
                self._forget(topic)
        here = [topic for topic in self._topics.values() if topic.waiting]
        clocks = {topic: topic.clock for topic in here}
        self._log_offset_ns = _log_offset_ns(clocks)
        # those with hardly a message go on waiting, unless nothing speaks against them
        few = [t for t in here if t.is_doubtful and t.waiting < MIN_MESSAGES and not t.is_scan]
        return self._settled([topic for topic in here if topic not in few])

    def _settled(self, topics: Collection[Topic]) -> list[Timed]:
        for topic in topics:
            _choose_source(topic, topic.clock, self._log_offset_ns, self._first_scan)
            topic.settle()
        here = [one for one in self._waiting if one.topic in topics]
        self._waiting = [one for one in self._waiting if one.topic not in topics]
        return [timed for one in here for timed in self._judged(one, has_waited=True)]

    def _judged(self, one: _Waiting, has_waited: bool) -> list[Timed]:
        frame = one.topic.judged(one.frame, self._log_offset_ns, has_waited)
        if isinstance(frame, str):
            if one.is_mapped and not isinstance(one.frame, GnssFix):  # one that is left out anyway is counted
                self._counters[_COUNTED[one.topic.is_scan, frame]] += 1
            return []
        return [Timed(frame, one.is_mapped)]

    def _forget(self, topic: Topic) -> None:
        self._counters[_COUNTED[False, EARLY]] += topic.forget()
        self._waiting = [one for one in self._waiting if one.topic is not topic]

    def _forget_oldest(self) -> None:
        if len(self._waiting) > MAX_SAMPLES:
            half = self._waiting[: MAX_SAMPLES // 2]
            del self._waiting[: MAX_SAMPLES // 2]
            for one in half:
                one.topic.dropped[EARLY] += 1
            self._counters[_COUNTED[False, EARLY]] += len(half)


def _log_offset_ns(clocks: Mapping[Topic, Clock]) -> int | None:
    """Log times less this are on the clock of all stamps; None: log times give nothing.

    The clock of the log is that of all where any topic keeps to it; else that of the scans counts.
    """
    scans = [clock for topic, clock in clocks.items() if topic.is_scan]
    if any(clock.verdict == "ordinary" for clock in clocks.values()):
        return 0
    for of_scans in scans:
        if of_scans.verdict == "offset" or of_scans.messages < MIN_MESSAGES:
            offsets = [clock.offset_ns for clock in clocks.values() if clock.verdict == "offset"]
            near = [d for d in offsets if abs(d - of_scans.offset_ns) <= MAX_LATENCY_NS]
            return min([*near, of_scans.offset_ns])
    return 0 if any(clock.verdict == "coarse" for clock in scans) else None


def _choose_source(
    topic: Topic, clock: Clock, log_offset_ns: int | None, first_scan: LaserScan | None
) -> None:
    """By what the times of a topic are taken, with a finding where not by its stamps as they are."""
    if log_offset_ns is None:
        if first_scan is not None and abs(topic.middle_stamp_ns - first_scan.stamp_ns) > MAX_STEP_NS:
            topic.source = "none"
            topic.findings.append(
                f"its stamps are {seconds(topic.middle_stamp_ns - first_scan.stamp_ns)} from those of the "
                "scans, and log times do not tell the offset; it is left out"
            )
        return
    if clock.verdict == "coarse":
        topic.source = "log"
        sweep = ", less the time of a sweep" if topic.is_scan else ""
        topic.findings.append(
            f"{counted(clock.distinct, 'stamp')} in {clock.messages} messages do not tell them apart; their "
            f"log times are used instead{sweep}. Does its driver set header.stamp?"
        )
    elif clock.verdict == "inconsistent" and clock.messages >= MIN_MESSAGES:
        topic.source = "log" if topic.is_scan else "none"
        used = "their log times are used instead" if topic.is_scan else "it is left out"
        topic.findings.append(
            f"its stamps neither keep to the log times nor have a constant offset to them ({clock.messages} "
            f"messages, fastest delay {seconds(clock.offset_ns)}); {used}"
        )
    elif clock.messages >= MIN_MESSAGES and not is_ordinary(clock.offset_ns - log_offset_ns):
        topic.shift_ns = clock.offset_ns - log_offset_ns - topic.sweep_ns
        behind = "behind" if topic.shift_ns > 0 else "ahead of"
        topic.findings.append(
            f"its stamps are {seconds(abs(topic.shift_ns))} {behind} those of the other topics by the log "
            f"times of {clock.messages} messages (uncertainty {seconds(clock.sigma_ns)}); they are corrected "
            "by that. Is the clock of its computer right?"
        )
