"""Callbacks of Zenoh in daemon threads, which do not keep the process alive."""

import logging
import queue
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import zenoh

log = logging.getLogger(__name__)

MAX_WAITING = 256  # as in Zenoh's own channel; then its reader of the link waits

T = TypeVar("T")


def daemon_callback(take: Callable[[T], object], name: str) -> "zenoh.handlers.Callback[T]":
    """For a subscriber, queryable or get: `take` is called in a daemon thread, which ends with it.

    The thread that Zenoh makes for a plain function is no daemon: a process that fails to close its session
    never ends. `atexit` has to close each session: Zenoh's calls into an interpreter that ends would
    abort the process. What `take` raises is logged.
    """
    waiting: queue.SimpleQueue[T | None] = queue.SimpleQueue()
    room = threading.Semaphore(MAX_WAITING)

    def put(came: T) -> None:
        room.acquire()
        waiting.put(came)

    def run() -> None:
        while (came := waiting.get()) is not None:
            room.release()
            try:
                take(came)
            except Exception:
                log.exception("%s", name)

    threading.Thread(target=run, name=name, daemon=True).start()
    return zenoh.handlers.Callback(put, partial(waiting.put, None), indirect=False)
