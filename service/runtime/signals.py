"""SIGTERM, SIGINT and SIGHUP as an event that the main thread waits for."""

import logging
import select
import signal
import socket
from types import FrameType, TracebackType
from typing import Self

log = logging.getLogger(__name__)

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class StopSignals:
    """While entered, a stop signal no longer ends the process: `wait` returns its name instead.

    Only the main thread may enter it. A second signal changes nothing, so it cannot cut a recording short:
    where one came, stop signals stay ignored after the exit, until the process ends with its exit code.
    Handlers wake `wait` through a socket, since an Event may not be set by the handler of its own waiter.
    """

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)
        self.received = ""

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._note) for number in STOP_SIGNALS}
        self._wakeup_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self.received else handler)
        signal.set_wakeup_fd(self._wakeup_before)  # last: its reader would receive a second signal
        self._reader.close()
        self._writer.close()

    def wait(self, timeout_s: float) -> str:
        """Name of the first stop signal that came, "" if none has within timeout_s."""
        if not self.received:
            ready, _, _ = select.select([self._reader], [], [], timeout_s)
            if ready:
                self._reader.recv(4096)
        return self.received

    def wake(self) -> None:
        """Let a waiting `wait` return at once; from any thread."""
        try:
            self._writer.send(b"\0")
        except BlockingIOError:
            pass  # it is awake already
        except OSError as error:
            log.debug("wake-up not sent: %s", error)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if not self.received:
            self.received = signal.Signals(number).name
