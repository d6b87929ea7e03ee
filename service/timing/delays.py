"""Faults of a topic's stamps by the delays from stamp to log time.

A message comes after it was measured, and soon: a constant delay out of the ordinary is the offset between
two clocks. What delays a message only makes it later, so the fastest ones are nearest to that offset.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

MAX_AHEAD_NS = 50_000_000  # of the log: two computers that keep each other's time
MAX_LATENCY_NS = 1_000_000_000  # from a measurement to its log time
SAME_DELAY_NS = 250_000_000  # between two delays of one clock
MIN_AGREEING_SHARE = 0.6  # of the messages, whose delays agree
MIN_ORDINARY = 0.3  # of the messages, where the newest are: the others were stamped by a clock that was set
MIN_MESSAGES = 3
COPY_SHARE = 0.5  # of the usual time between two messages, within which a copy comes
FASTEST_SHARE = 0.05  # of the delays are passed over in search of the fastest: single stamps may be ahead
SHORTEST_DELAY_NS = 2_000_000  # of a message to the log; 0.3 to 3 ms by device, docs/decisions/0003-time.md
MIN_SIGMA_NS = 5_000_000  # of an offset, as log times do not tell that

Verdict = Literal["ordinary", "offset", "coarse", "inconsistent"]
Stamps = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Clock:
    """A topic's stamps against log times.

    offset_ns, sigma_ns  log time less stamp less the shortest transport, and how well it is known; of
                         scans the sweep is in it
    distinct             how many of the stamps differ
    """

    verdict: Verdict
    offset_ns: int
    sigma_ns: int
    messages: int
    distinct: int


def is_ordinary(delay_ns: int) -> bool:
    """Whether a stamp may be of the clock of the log."""
    return -MAX_AHEAD_NS <= delay_ns <= MAX_LATENCY_NS


def clock_of(stamp_ns: Sequence[int], log_ns: Sequence[int]) -> Clock:
    """Of messages in the order of their log times; one or more."""
    stamps, logs = _without_copies(np.array(stamp_ns, np.int64), np.array(log_ns, np.int64))
    delays = logs - stamps
    near = delays[np.abs(delays - _middle(delays)) <= MAX_LATENCY_NS]
    ordinary = (delays >= -MAX_AHEAD_NS) & (delays <= MAX_LATENCY_NS)
    if is_kept := ordinary.mean() >= MIN_ORDINARY and bool(ordinary[-MIN_MESSAGES:].all()):
        near = delays[ordinary]
    fastest_ns = int(np.sort(near)[int(FASTEST_SHARE * len(near))])
    sigma_ns = max(int((near - fastest_ns).mean()), MIN_SIGMA_NS)
    distinct = len(np.unique(stamps))
    return Clock(
        _verdict(stamps, logs, near, is_kept), fastest_ns - SHORTEST_DELAY_NS, sigma_ns, len(stamps), distinct
    )


def _without_copies(stamps: Stamps, logs: Stamps) -> tuple[Stamps, Stamps]:
    """A message that comes at once after one with its stamp is a copy: the topic was recorded twice."""
    at_once_ns = COPY_SHARE * (logs[-1] - logs[0]) / max(len(logs) - 1, 1)
    is_new = np.ones(len(stamps), np.bool_)
    is_new[1:] = (np.diff(stamps) != 0) | (np.diff(logs) > at_once_ns)
    return stamps[is_new], logs[is_new]


def _verdict(stamps: Stamps, logs: Stamps, near: Stamps, is_kept: bool) -> Verdict:
    """near: delays that agree, in their order; is_kept: they are those of the clock of the log."""
    count = len(stamps)
    if count >= MIN_MESSAGES and len(np.unique(stamps)) <= MIN_AGREEING_SHARE * count < len(np.unique(logs)):
        return "coarse"
    if is_kept:
        return "ordinary"
    if count < MIN_MESSAGES or len(near) < MIN_AGREEING_SHARE * count or _changes(near):
        return "inconsistent"
    return "ordinary" if is_ordinary(_middle(near)) else "offset"


def _changes(delays: Stamps) -> bool:
    """Whether stamps run at another pace than the log."""
    half = len(delays) // 2
    return half >= 2 and abs(_middle(delays[half:]) - _middle(delays[:half])) > SAME_DELAY_NS


def _middle(values: Stamps) -> int:
    """The median, exact: ns of many days are beyond the 53 bits of a float."""
    return int(np.partition(values, len(values) // 2)[len(values) // 2])
