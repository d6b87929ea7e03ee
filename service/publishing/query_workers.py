"""Answers to queries that take a while: a thread each, of bounded number."""

import logging
import threading
import time
from collections.abc import Callable

from service.allowance import Allowance

log = logging.getLogger(__name__)

MAX_AT_ONCE = 16  # each waits some seconds at most; a faster client gets an error
MAX_PER_S = 50.0  # each takes processor from the scans
BURST = 100.0
CLOSE_TIMEOUT_S = 10.0


class QueryWorkers:
    """owner: the sink whose threads these are."""

    def __init__(self, owner: str) -> None:
        self._owner = owner
        self._allowance = Allowance(MAX_PER_S, BURST)
        self._lock = threading.Lock()
        self._threads: dict[threading.Thread, str] = {}  # each with what it answers

    def start(self, name: str, work: Callable[[], None]) -> str:
        """Run it in a thread of its own. Returns why that is not possible, "" if it is."""

        def run() -> None:
            try:
                work()
            finally:
                with self._lock:
                    del self._threads[threading.current_thread()]

        thread = threading.Thread(target=run, name=f"{self._owner}-command", daemon=True)
        with self._lock:
            if not self._allowance.takes_one():
                return f"commands come faster than {MAX_PER_S:.0f} a second; ask again in a moment"
            if len(self._threads) >= MAX_AT_ONCE:
                return f"{MAX_AT_ONCE} commands are being worked on; ask again in a moment"
            self._threads[thread] = name
            try:
                thread.start()  # to leave the others it needs the lock
            except RuntimeError as error:  # the system gives no more threads
                del self._threads[thread]
                return f"no thread for it: {error}; ask again in a moment"
        return ""

    def close(self) -> None:
        """Wait for the answers that are being made; the log names those that are not in time."""
        with self._lock:
            threads = dict(self._threads)
        until_s = time.monotonic() + CLOSE_TIMEOUT_S
        for thread, name in threads.items():
            thread.join(max(until_s - time.monotonic(), 0.0))
            if thread.is_alive():
                log.error(
                    "command %r is not done after %.0f s; who asked hears no answer", name, CLOSE_TIMEOUT_S
                )
