"""The queue between the reader threads and the mapping thread.

Frames leave in the order in which they came. When the mapper falls behind, old scans go first: a scan more or
less costs little, but a missing odometry or IMU sample bends the prediction, so samples are never dropped.
"""

import threading
from collections import Counter, deque

from drivers.frames import Frame, LaserScan

SCAN_CAPACITY = 64  # over a second of one laser; the mapper needs a few milliseconds a scan
SAMPLE_CAPACITY = 20_000  # minutes of odometry; only a mapping thread that is stuck lets it fill


class FrameQueue:
    """Bounded, many writers, one reader."""

    def __init__(self, scan_capacity: int = SCAN_CAPACITY, sample_capacity: int = SAMPLE_CAPACITY) -> None:
        self._scan_capacity = scan_capacity
        self._sample_capacity = sample_capacity
        self._frames: deque[Frame] = deque()
        self._scans = 0
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
            elif len(self._frames) - self._scans >= self._sample_capacity:
                raise OverflowError(
                    f"{frame.sensor}: {self._sample_capacity} samples wait; the mapping thread is stuck"
                )
            self._frames.append(frame)
            self.deepest = max(self.deepest, len(self._frames))
            self._changed.notify()

    def get(self, timeout_s: float) -> Frame | None:
        """The next frame; None when none came within timeout_s, or when closed and empty."""
        with self._changed:
            if not self._frames and not self._closed:
                self._changed.wait(timeout_s)
            if not self._frames:
                return None
            frame = self._frames.popleft()
            self._scans -= isinstance(frame, LaserScan)
            return frame

    def close(self) -> None:
        """Take no more frames; what waits can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def drained(self) -> bool:
        """Closed and empty: nothing will come any more."""
        with self._changed:
            return self._closed and not self._frames

    def __len__(self) -> int:
        return len(self._frames)

    def _drop_oldest_scan(self) -> None:
        for index, waiting in enumerate(self._frames):
            if isinstance(waiting, LaserScan):
                del self._frames[index]
                self._scans -= 1
                self.dropped_scans[waiting.sensor] += 1
                return
