"""How often something may happen: so many times a second, and some at once."""

import time
from collections.abc import Callable


class Allowance:
    """One thread asks. per_s: on average; at_once: after a rest."""

    def __init__(
        self, per_s: float, at_once: float, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._per_s, self._at_once = per_s, at_once
        self._monotonic_s = monotonic_s
        self._left = at_once
        self._requested_s = monotonic_s()

    def takes_one(self) -> bool:
        """Whether one more may happen now; what may not is not counted."""
        now_s = self._monotonic_s()
        earned = (now_s - self._requested_s) * self._per_s
        self._requested_s = now_s
        self._left = min(self._at_once, self._left + earned)
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
