"""Threads beside a test, which end with it: none keeps the process alive, none fails unseen."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

Result = TypeVar("Result")


def started(work: Callable[[], Result]) -> Future[Result]:
    """Do it in a thread of its own. `result(timeout)` is what it returned, or raises what it raised."""
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:  # result() raises it
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


@contextmanager
def in_background(work: Callable[[threading.Event], object], timeout_s: float = 30.0) -> Iterator[None]:
    """Does the work, which ends soon after the event that it is given is set: at the end of the block."""
    ended = threading.Event()
    working = started(partial(work, ended))
    try:
        yield
    finally:
        ended.set()
        assert wait((working,), timeout_s).done, f"still at work {timeout_s:.0f} s after it was to end"
        working.result()
