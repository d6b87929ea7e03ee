"""For a change by another thread or process without an event."""

import threading
import time
from collections.abc import Callable


def wait_until(condition: Callable[[], object], timeout_s: float = 30.0, words: str = "it is not so") -> None:
    """Check each 5 ms. Raises AssertionError, with the words, where it is not so in time."""
    pause, deadline_s = threading.Event(), time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"after {timeout_s} s {words}"
        pause.wait(0.005)
