"""Threads whose failure ends the service."""

import logging
import threading
from collections.abc import Callable

log = logging.getLogger(__name__)


class Workers:
    """Named threads; the first exception that leaves one of them is kept and `on_failure` is called.

    A service without one of its threads lives and maps nothing, so its owner watches `failure`
    and stops the others in good order.
    """

    def __init__(self, on_failure: Callable[[], None]) -> None:
        self._on_failure = on_failure
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self.failure: str = ""  # which thread failed, and how; "" while none has

    def start(self, name: str, work: Callable[[], None]) -> threading.Thread:
        thread = threading.Thread(target=self._guard, args=(name, work), name=name, daemon=True)
        self._threads.append(thread)
        thread.start()
        return thread

    def join(self, thread: threading.Thread, timeout_s: float) -> bool:
        """Wait for one thread to end; False, and a warning, if it does not within timeout_s."""
        thread.join(timeout_s)
        if thread.is_alive():
            log.error("thread %s did not end within %.1f s; leaving it behind", thread.name, timeout_s)
            return False
        return True

    def fail(self, name: str, error: BaseException) -> None:
        """Note that `name` cannot go on. Only the first failure counts; the others follow from it."""
        with self._lock:
            if not self.failure:
                self.failure = f"{name}: {type(error).__name__}: {error}"
        self._on_failure()

    def _guard(self, name: str, work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:  # also SystemExit: nothing may end a thread unseen
            log.exception("thread %s failed", name)
            self.fail(name, error)
