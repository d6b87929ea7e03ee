"""The threads of a sink that send, and what became of what they sent."""

import logging
import threading
from collections import Counter
from collections.abc import Callable, Mapping

import zenoh

from service.errors import StorageError

log = logging.getLogger(__name__)

CLOSE_TIMEOUT_S = 5.0


class Senders:
    """owner: the sink; its threads are named "<owner>-<name>"."""

    def __init__(self, owner: str) -> None:
        self._owner = owner
        self._lock = threading.Lock()  # of the counters
        self._sent: Counter[str] = Counter()
        self._failed: Counter[str] = Counter()
        self._threads: list[threading.Thread] = []

    def start(self, runs: Mapping[str, Callable[[], None]]) -> None:
        """A thread each, by name."""
        for name, run in runs.items():
            self._threads.append(threading.Thread(target=run, name=f"{self._owner}-{name}", daemon=True))
        for thread in self._threads:
            thread.start()

    def join(self) -> None:
        """Wait until they have ended; the log names those that are not in time, and they are left behind."""
        for thread in self._threads:
            thread.join(CLOSE_TIMEOUT_S)
            if thread.is_alive():
                log.error(
                    "%s is still sending after %.0f s; closing Zenoh under it", thread.name, CLOSE_TIMEOUT_S
                )

    def attempt(self, channel: str, action: Callable[[], None]) -> bool:
        """Do it; a fault is counted and must not end the thread: the next message may well go through."""
        try:
            action()
        except (zenoh.ZError, StorageError, ValueError) as error:
            with self._lock:
                self._failed[channel] += 1
                is_first = self._failed[channel] == 1
            log.log(logging.ERROR if is_first else logging.DEBUG, "%s %s: %s", self._owner, channel, error)
            return False
        return True

    def count(self, channel: str) -> None:
        """One more was sent."""
        with self._lock:
            self._sent[channel] += 1

    def sent(self) -> Counter[str]:
        """Messages sent so far, by channel."""
        with self._lock:
            return Counter(self._sent)

    def failed(self) -> Counter[str]:
        """What raised so far, by channel; the first of each is in the log."""
        with self._lock:
            return Counter(self._failed)
