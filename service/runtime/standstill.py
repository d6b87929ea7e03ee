"""Whether a process that owes something works at it, waits for a processor, or stands still."""

import time
from pathlib import Path


class Standstill:
    """For how long a process has neither run nor waited for a processor, as far as `seconds` was asked.

    One that is stopped, sleeps or waits for a disk stands still; one that a busy machine starves does not.
    """

    def __init__(self) -> None:
        self._since_s: float | None = None  # host monotonic

    def seconds(self, pid: int) -> float:
        """pid: of a process without further threads. 0.0 while it runs."""
        if _state(pid) == "R":
            self._since_s = None
            return 0.0
        now_s = time.monotonic()
        if self._since_s is None:
            self._since_s = now_s
        return now_s - self._since_s

    def reset(self) -> None:
        """It has been heard of."""
        self._since_s = None


def _state(pid: int) -> str:
    """As of proc(5): R, S, D, T ...; "" where it is gone."""
    try:
        stat = Path("/proc", str(pid), "stat").read_text(errors="replace")
    except OSError:
        return ""
    return stat.rpartition(")")[2].split()[0]
