"""A thread beside a test, which ends with it."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def in_background(work: Callable[[threading.Event], None], timeout_s: float = 30.0) -> Iterator[None]:
    """Does the work, which ends soon after the event that it is given is set: at the end of the block."""
    ended = threading.Event()
    thread = threading.Thread(target=work, args=(ended,))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(timeout_s)
        assert not thread.is_alive(), f"still at work {timeout_s:.0f} s after it was to end"
