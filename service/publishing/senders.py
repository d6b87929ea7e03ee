"""Queues and threads of a sink that sends, counts of what they sent, and what is closed after them."""

import logging
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack

import zenoh

from service.errors import StorageError
from service.publishing.send_queues import Bulk, BulkQueue, Sending, StreamQueue

log = logging.getLogger(__name__)

STREAM_CAPACITY = 512  # messages; one to two seconds of a vehicle with five sensors
CLOSE_TIMEOUT_S = 5.0


class Senders:
    """owner: the sink; its threads are "<owner>-stream" and "<owner>-bulk"."""

    def __init__(self, owner: str, tile_period_s: float, picture_period_s: float) -> None:
        self._owner = owner
        self.stream = StreamQueue(STREAM_CAPACITY)
        self.bulk = BulkQueue(tile_period_s, picture_period_s)
        self.opened = ExitStack()  # what `close` undoes when the threads have ended, the newest first
        self.closed = False
        self._lock = threading.Lock()  # of the counters
        self._sent: Counter[str] = Counter()
        self._failed: Counter[str] = Counter()
        self._threads: list[threading.Thread] = []

    def start(self, send: Callable[[Sending], None], send_bulk: Callable[[Bulk], None]) -> None:
        """Have a thread for each queue call these; what they raise ends it, so they `attempt`."""

        def run_stream() -> None:
            while batch := self.stream.take():
                for sending in batch:
                    send(sending)

        def run_bulk() -> None:
            while (bulk := self.bulk.take()) is not None:
                send_bulk(bulk)

        for name, run in {"stream": run_stream, "bulk": run_bulk}.items():
            self._threads.append(threading.Thread(target=run, name=f"{self._owner}-{name}", daemon=True))
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Send what waits, then undo what was opened. A second call does nothing.

        The log names a thread that does not end in time, and it is left behind.
        """
        if self.closed:
            return
        self.closed = True
        self.stream.close()
        self.bulk.close()
        for thread in self._threads:
            thread.join(CLOSE_TIMEOUT_S)
            if thread.is_alive():
                log.error(
                    "%s is still sending after %.0f s; closing Zenoh under it", thread.name, CLOSE_TIMEOUT_S
                )
        try:
            self.opened.close()
        except zenoh.ZError as error:
            log.error("%s does not close: %s", self._owner, error)

    def attempt(self, channel: str, action: Callable[[], None]) -> bool:
        """Call it; an error is counted and does not end the thread."""
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
        """Count a sent message."""
        with self._lock:
            self._sent[channel] += 1

    def counts(self) -> dict[str, Counter[str]]:
        """So far, by channel: "sent", "dropped" before it, and "failed" (the first is in the log)."""
        with self._lock:
            sent, failed = Counter(self._sent), Counter(self._failed)
        return {"sent": sent, "dropped": self.stream.dropped(), "failed": failed}
