"""The queue between the reader threads and the mapping thread.

Frames leave in the order in which they came. When the mapper falls behind, old scans go first: a scan more or
less costs little, but a missing odometry or IMU sample bends the prediction, so samples are never dropped.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.frames import Frame, LaserScan
from service.encoding import Message

SCAN_CAPACITY = 128  # a second of three lasers; the mapper needs a few milliseconds a scan
SAMPLE_CAPACITY = 20_000  # minutes of odometry; only a mapping thread that is stuck lets it fill
COMMAND_CAPACITY = 32  # who commands waits for the answer, so more than a few are a fault


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """Travels among the frames, for its place among them matters; carried out between two of them.

    event        what stands in /events at that place
    carry_out    takes that event, encoded, with the log time of the place; runs in the mapping thread, so it
                 waits for nothing and raises nothing
    """

    arrived_ns: int  # host monotonic
    event: Mapping[str, str]
    carry_out: Callable[[Message], None]


class FrameQueue:
    """Bounded, many writers, one reader."""

    def __init__(self, scan_capacity: int = SCAN_CAPACITY, sample_capacity: int = SAMPLE_CAPACITY) -> None:
        self._scan_capacity = scan_capacity
        self._sample_capacity = sample_capacity
        self._waiting: deque[Frame | Command] = deque()
        self._scans = self._commands = 0
        self._closed = False
        self._changed = threading.Condition()
        self.dropped_scans: Counter[str] = Counter()  # by sensor
        self.deepest = 0  # most frames that ever waited

    def put(self, frame: Frame) -> None:
        """Append a frame; the oldest waiting scan makes room for a new one. After close() frames are ignored.

        Raises OverflowError when sample_capacity samples wait, for then the mapping thread is stuck.
        """
        with self._changed:
            if self._closed:
                return
            if isinstance(frame, LaserScan):
                if self._scans == self._scan_capacity:
                    self._drop_oldest_scan()
                self._scans += 1
            elif len(self._waiting) - self._scans - self._commands >= self._sample_capacity:
                raise OverflowError(
                    f"{frame.sensor}: {self._sample_capacity} samples wait; the mapping thread is stuck"
                )
            self._waiting.append(frame)
            self.deepest = max(self.deepest, len(self._waiting))
            self._changed.notify()

    def put_command(self, command: Command) -> str:
        """Append a command; why it is not taken, "" if it is."""
        with self._changed:
            if self._closed:
                return "the service is stopping"
            if self._commands >= COMMAND_CAPACITY:
                return f"{self._commands} commands wait for the mapping thread"
            self._commands += 1
            self._waiting.append(command)
            self._changed.notify()
            return ""

    def get(self, timeout_s: float) -> Frame | Command | None:
        """What is next; None when nothing came within timeout_s, or when closed and empty."""
        with self._changed:
            if not self._waiting and not self._closed:
                self._changed.wait(timeout_s)
            if not self._waiting:
                return None
            item = self._waiting.popleft()
            self._scans -= isinstance(item, LaserScan)
            self._commands -= isinstance(item, Command)
            return item

    def close(self) -> None:
        """Take no more frames; what waits can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def drained(self) -> bool:
        """Closed and empty: nothing will come any more."""
        with self._changed:
            return self._closed and not self._waiting

    def __len__(self) -> int:
        return len(self._waiting)

    def _drop_oldest_scan(self) -> None:
        for index, waiting in enumerate(self._waiting):
            if isinstance(waiting, LaserScan):
                del self._waiting[index]
                self._scans -= 1
                self.dropped_scans[waiting.sensor] += 1
                return
