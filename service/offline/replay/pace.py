"""Speed of a replay, and its observers. Neither changes the result."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence

from drivers.frames import LaserScan
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.outputs import MapperOutput, TileUpdate
from service.recording.mcap_source import Session


class Pace:
    """Keeps log time and the clock in step, and can be halted, sent ahead and changed from any thread.

    rate    seconds of log time a second; 0: as fast as it goes
    """

    def __init__(self, rate: float, is_paused: bool = False) -> None:
        self._changed = threading.Condition()  # of all that follows
        self._rate = rate
        self._is_paused = is_paused
        self._until_ns: int | None = None  # log time to go to as fast as it goes, and to pause there
        self._anchor: tuple[float, int] | None = None  # moment and log time that belong together
        self._is_free = rate == 0.0 and not is_paused  # nothing to wait for: the common case, without a lock

    @property
    def rate(self) -> float:
        return self._rate

    @property
    def is_paused(self) -> bool:
        return self._is_paused

    def pause(self) -> None:
        self._set(is_paused=True, until_ns=None)

    def resume(self) -> None:
        self._set(is_paused=False, until_ns=None)

    def go_to(self, log_ns: int) -> None:
        """Go to that log time as fast as it goes, and pause there."""
        self._set(is_paused=False, until_ns=log_ns)

    def set_rate(self, rate: float) -> None:
        with self._changed:
            self._rate = rate
            self._restart()

    def wait_for(self, log_ns: int, before_waiting: Callable[[], None] | None = None) -> None:
        """Return when a step of that log time may be taken.

        before_waiting  called once if it is to be waited for
        """
        if self._is_free:
            return
        with self._changed:
            is_reported = before_waiting is None
            while (wait_s := self._wait_s(log_ns)) != 0.0:
                if not is_reported and before_waiting is not None:
                    is_reported = True
                    before_waiting()
                else:
                    self._changed.wait(wait_s)

    def _set(self, is_paused: bool, until_ns: int | None) -> None:
        with self._changed:
            self._is_paused, self._until_ns = is_paused, until_ns
            self._restart()

    def _restart(self) -> None:
        self._anchor = None
        self._is_free = self._rate == 0.0 and not self._is_paused and self._until_ns is None
        self._changed.notify_all()

    def _wait_s(self, log_ns: int) -> float | None:
        """0.0: it may be taken; None: until something changes."""
        if self._until_ns is not None:
            if log_ns < self._until_ns:
                return 0.0
            self._is_paused, self._until_ns = True, None
        if self._is_paused:
            return None
        if self._rate == 0.0:
            return 0.0
        if self._anchor is None:
            self._anchor = (time.monotonic(), log_ns)
        due_s = self._anchor[0] + (log_ns - self._anchor[1]) / 1e9 / self._rate
        return max(due_s - time.monotonic(), 0.0)


class Watch:
    """Keeps the pace of replays, one after another, in the thread that maps. A subclass observes them, too.

    rate    as of Pace
    """

    def __init__(self, rate: float, is_paused: bool = False) -> None:
        self._pace = Pace(rate, is_paused)

    def begin(self, session: Session, mapper: MappingSession, poses_base_sensor: Mapping[str, SE2]) -> None:
        """A recording begins; with the mountings of its lasers."""

    def wait_for(self, log_ns: int) -> None:
        """Before a step of that log time: return when it may be taken."""
        self._pace.wait_for(log_ns)

    def mapped(self, scan: LaserScan, output: MapperOutput) -> None:
        """A scan was mapped."""

    def closing(self) -> None:
        """All scans of a map are mapped; its last loops are searched."""

    def finished(self, tiles: Sequence[TileUpdate], poses_map_base: Sequence[SE2]) -> None:
        """A map is finished, by a reset or at the end: what it is, and where its scans lie in the end."""
