"""Which frames the mapper is given while items wait for it."""

from service.runtime.mapper_messages import FrameItem, is_sample

MAX_AHEAD = 2_000  # items that wait ahead of a scan: it would be too old when its turn comes
MAX_WAITING = 60_000  # items, minutes of five devices: then frames are left out until MAX_AHEAD are left


class Backlog:
    """Bounded, however slow the mapper is; one that has stopped is replaced long before it is full."""

    def __init__(self) -> None:
        self._is_full = False

    def takes(self, frame: FrameItem, waiting: int) -> bool:
        """waiting: items ahead of the frame."""
        self._is_full = waiting >= MAX_WAITING or (self._is_full and waiting > MAX_AHEAD)
        return not self._is_full and (waiting < MAX_AHEAD or is_sample(frame))
