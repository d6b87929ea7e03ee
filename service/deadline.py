"""The one deadline of a shutdown, which all of its waits share."""

import time

WORKING_S = 60.0  # while every part works: a large map, a slow disk
HUNG_S = 8.0  # once a part hangs
SAVE_S = 3.0  # of either for recording and map, also where the part is found late


class Deadline:
    """Counts from its construction. Thread-safe."""

    def __init__(self) -> None:
        self._began_s = time.monotonic()
        self._until_s = self._began_s + WORKING_S

    @property
    def left_s(self) -> float:
        return max(self._until_s - time.monotonic(), 0.0)

    def found_hung(self) -> None:
        """A part hangs: the others end soon."""
        soon_s = max(self._began_s + HUNG_S, time.monotonic() + SAVE_S)
        self._until_s = min(self._until_s, soon_s)
