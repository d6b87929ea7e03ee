"""Whether the mapper has sent nothing for too long."""

import time

from service.runtime.standstill import Standstill

STUCK_S = 10.0  # items wait, and the mapper has sent nothing for so long: it is ended
# So early where it was stopped for half of that, or computed for half of it and has announced no long work:
# a scan takes milliseconds, and one that a busy machine leaves without a processor does neither.
STILL_S = 2.0


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
        idle_s = still_s if self._long_works else max(still_s, computed_s)
        return self.seconds > STUCK_S or (self.seconds > STILL_S and idle_s > STILL_S / 2.0)
