"""Whether a process with open work computes, waits for a processor, or stands still; the silent mapper."""

import os
import time
from pathlib import Path
from typing import NamedTuple

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
STUCK_S = 10.0  # items wait, and the mapper has sent nothing for so long: it is ended
# So early where it was stopped for half of that, or computed for half of it and has announced no long work:
# a scan takes milliseconds, and one that a busy machine leaves without a processor does neither.
STILL_S = 2.0
# Announced work, such as beginning in the map of a large site, may compute for so long, and take so long.
LONG_COMPUTED_S, LONG_WORK_S = 30.0, 120.0


class Standstill:
    """For how long a process has neither run nor waited for a processor, and how much of one it has used, as
    far as it was measured since its last message.

    One that is stopped, sleeps or waits for a disk stands still; one that a busy machine starves does
    neither.
    """

    def __init__(self) -> None:
        self._since_s: float | None = None  # host monotonic
        self._used_s: float | None = None  # processor time at its last message, or first measured since

    def seconds(self, pid: int) -> tuple[float, float]:
        """Stopped, 0.0 while it runs; and computed since. pid: of a process without further threads."""
        now = _now(pid)
        if self._used_s is None:
            self._used_s = now.used_s
        computed_s = now.used_s - self._used_s
        if now.state == "R":
            self._since_s = None
            return 0.0, computed_s
        now_s = time.monotonic()
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s, computed_s

    def reset(self) -> None:
        """It has sent a message."""
        self._since_s = self._used_s = None


class _Now(NamedTuple):
    state: str  # as of proc(5): R, S, D, T ...; "" where it is gone
    used_s: float


def _now(pid: int) -> _Now:
    try:
        stat = Path("/proc", str(pid), "stat").read_text(errors="replace")
    except OSError:
        return _Now("", 0.0)
    fields = stat.rpartition(")")[2].split()
    return _Now(fields[0], (int(fields[11]) + int(fields[12])) / _TICKS_PER_S)


class MapperSilence:
    """Silence of the mapper that items are sent to."""

    def __init__(self) -> None:
        self._heard_s = 0.0  # host monotonic
        self._standstill = Standstill()
        self._long_works = 0  # announced and not ended

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._heard_s

    def begin(self) -> None:
        """Another mapper gets the items from now on."""
        self._long_works = 0
        self.heard()

    def heard(self) -> None:
        self._heard_s = time.monotonic()
        self._standstill.reset()

    def announce(self, has_begun: bool) -> None:
        """Take a LongWork message."""
        self._long_works += 1 if has_begun else -1

    def is_too_long(self, pid: int) -> bool:
        """pid: of the mapper, while an answer is due."""
        if self.seconds <= STILL_S / 2.0:
            return False
        still_s, computed_s = self._standstill.seconds(pid)
        is_still = self.seconds > STILL_S and still_s > STILL_S / 2.0
        if self._long_works:
            return is_still or computed_s > LONG_COMPUTED_S or self.seconds > LONG_WORK_S
        return is_still or self.seconds > (STILL_S if computed_s > STILL_S / 2.0 else STUCK_S)
