"""Checks of every session: silence, only malformed messages, impossible stamps."""

from collections import Counter
from typing import NamedTuple, Protocol

from drivers.errors import ProtocolError, TransportError

LOOK_NS = 200_000_000  # between two calls of `look` at most this counts as silence: the host may have stalled


class DropReason(NamedTuple):
    """Why a complete frame is not handed on, and the remedy where all are dropped for it."""

    words: str
    remedy: str


SAME_STAMP = DropReason("with the same stamp", "the sensor stalls: switch its power off and on")
OUT_OF_ORDER = DropReason(
    "stamped no later than the one before",
    "its clock stalls or was set: switch its power off and on; of a ROS node look at header.stamp",
)
AHEAD_OF_ARRIVAL = DropReason(
    "stamped later than they arrived",
    "its clock is damaged or was set: switch its power off and on; of a ROS node look at header.stamp",
)
DAMAGED = DropReason(
    "damaged on the way", "look at plugs, cable and ground, and whether another program reads this port"
)
OUTSIDE = DropReason(
    "without a beam in the configured field of view",
    "write first_angle_deg and last_angle_deg as the sensor is set, or widen its field of view",
)
NOT_FINITE = DropReason(
    "with values that are no numbers", "switch its power off and on; if they stay so, have it repaired"
)


class SilenceWatch:
    """Time for which a device has sent no usable frame, counted while it was watched.

    Call `look` at every tick, `heard` for each frame that is handed on, and `dropped` for each that came
    complete and is not: those do not end the silence, but distinguish it from that of an unplugged cable.
    """

    def __init__(self) -> None:
        self._looked_at_ns: int | None = None
        self._silent_ns = 0
        self._dropped: Counter[DropReason] = Counter()  # since the last frame that was handed on
        self._silent_at_drop_ns = 0  # at the newest of them

    def look(self, now_ns: int, waiting: bool) -> None:
        """waiting: the device should be sending; time before the request does not count."""
        if waiting and self._looked_at_ns is not None:
            self._silent_ns += min(now_ns - self._looked_at_ns, LOOK_NS)
        self._looked_at_ns = now_ns

    def heard(self) -> None:
        self._silent_ns = self._silent_at_drop_ns = 0
        self._dropped.clear()

    def dropped(self, reason: DropReason, count: int = 1) -> None:
        if count:
            self._dropped[reason] += count
            self._silent_at_drop_ns = self._silent_ns

    def exceeds(self, limit_s: float) -> bool:
        return self._silent_ns > limit_s * 1e9

    def what_came(self, what: str, limit_s: float) -> str:
        """For the error where `limit_s` is exceeded: which frames came all the same, and the remedy; empty
        where none came in the later half of that time.

        what    plural, as in the counters: scans
        """
        count = self._dropped.total()
        if count < 2 or self._silent_ns - self._silent_at_drop_ns > limit_s * 0.5e9:
            return ""
        ranked = self._dropped.most_common()
        words = (
            f"all {ranked[0][0].words}"
            if len(ranked) == 1
            else "none usable: " + ", ".join(f"{number} {reason.words}" for reason, number in ranked)
        )
        return f"{count} {what} came in {limit_s:g} s, {words}; {ranked[0][0].remedy}"


class StampGate:
    """Lets frames pass that are stamped no later than their arrival, and later than the one before.

    Others are counted as `<what>_ahead_of_arrival` and `<what>_out_of_order`, and `silence` is set, where
    there is one.
    """

    def __init__(self, counters: Counter[str], what: str, silence: SilenceWatch | None = None) -> None:
        self._counters = counters
        self._what = what
        self._silence = silence
        self.last_ns: int | None = None  # stamp of the newest frame that passed

    def passes(self, stamp_ns: int, arrived_ns: int) -> bool:
        if stamp_ns > arrived_ns:
            self._drop("ahead_of_arrival", AHEAD_OF_ARRIVAL)
            return False
        if self.last_ns is not None and stamp_ns <= self.last_ns:
            self._drop("out_of_order", OUT_OF_ORDER)
            return False
        self.last_ns = stamp_ns
        return True

    def _drop(self, name: str, reason: DropReason) -> None:
        self._counters[f"{self._what}_{name}"] += 1
        if self._silence is not None:
            self._silence.dropped(reason)


class MalformedRun:
    """Counts malformed messages as `<what>_malformed`, and ends a session where only such come.

    what     plural, as in the counters: scans
    limit    this many in a row are tolerated
    """

    def __init__(self, counters: Counter[str], what: str, limit: int) -> None:
        self._counters = counters
        self._what = what
        self._limit = limit
        self._in_a_row = 0

    def bad(self, error: ProtocolError) -> None:
        """Count one. Raises ProtocolError where there are more than `limit` in a row."""
        self._counters[f"{self._what}_malformed"] += 1
        self._in_a_row += 1
        if self._in_a_row > self._limit:
            raise ProtocolError(f"{self._in_a_row} malformed {self._what} in a row: {error}") from error

    def good(self) -> None:
        self._in_a_row = 0


class KnownOffset(Protocol):
    """A device's clock in host time."""

    @property
    def offset_ns(self) -> int | None: ...
    @property
    def offset_sigma_ns(self) -> int | None: ...


class WatchedSession:
    """Base of a session that ends where no usable frame comes; see drivers.link.Session.

    what               its frames in counters and errors, plural: scans
    malformed_limit    this many malformed messages in a row are tolerated
    """

    _clock: KnownOffset | None = None

    def __init__(self, what: str, counters: Counter[str], malformed_limit: int) -> None:
        self.outbox = bytearray()
        self.counters = counters
        self.identity: dict[str, str] = {}
        self.status = ""
        self._what = what
        self._silence = SilenceWatch()
        self._malformed = MalformedRun(counters, what, malformed_limit)
        self._gate = StampGate(counters, what, self._silence)

    @property
    def clock_offset_ns(self) -> int | None:
        return None if self._clock is None else self._clock.offset_ns

    @property
    def clock_sigma_ns(self) -> int | None:
        return None if self._clock is None else self._clock.offset_sigma_ns

    def _count(self, **totals: int) -> None:
        """Counters of the whole session that others keep; those of 0 are left out."""
        for name, total in totals.items():
            if total:
                self.counters[name] = total

    def _end_where_silent(self, now_ns: int, limit_s: float, waiting: bool, otherwise: str) -> None:
        """At every tick. Raises TransportError after limit_s; otherwise: its words where nothing came."""
        self._silence.look(now_ns, waiting)
        if self._silence.exceeds(limit_s):
            raise TransportError(self._silence.what_came(self._what, limit_s) or otherwise)
