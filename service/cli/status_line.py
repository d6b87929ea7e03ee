"""One line at the foot of the terminal while a service runs; elsewhere a line of the log now and then."""

import logging
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO, cast

from service.cli.console import CLEAR, bar

if TYPE_CHECKING:  # it imports numpy
    from service.runtime.service import Service

log = logging.getLogger(__name__)

REDRAW_S = 0.5
PLAIN_S = 10.0  # between two lines off a terminal


class StatusLine:
    """Call it as often as you like with the service; it shows what is new when it is time."""

    def __init__(
        self,
        stream: TextIO,
        monotonic_s: Callable[[], float] = time.monotonic,
        is_reported_elsewhere: bool = "NOTIFY_SOCKET" in os.environ,
    ) -> None:
        """is_reported_elsewhere   systemd shows the status: no lines then in the journal"""
        self._stream = stream
        self._monotonic_s = monotonic_s
        self._terminal = stream.isatty()
        self._is_reported_elsewhere = is_reported_elsewhere
        self._began_s = self._due_s = monotonic_s()
        self._is_ready = False
        self._shown = ""

    def __call__(self, service: "Service") -> None:
        now_s = self._monotonic_s()
        if now_s < self._due_s or (self._is_reported_elsewhere and not self._terminal):
            return
        self._due_s = now_s + (REDRAW_S if self._terminal else PLAIN_S)
        words = self._words(service, now_s)
        if self._terminal:
            self._shown = words[: shutil.get_terminal_size().columns - 1]
            self._draw()
        elif words:
            log.info("%s", words)

    def write(self, text: str) -> int:
        """Of a log handler: what it writes goes above the line."""
        self._stream.write(f"{CLEAR}{text}" if self._shown else text)
        self._draw()
        return len(text)

    def flush(self) -> None:
        self._stream.flush()

    def end(self) -> None:
        """Take the line away."""
        if self._shown:
            self._stream.write(CLEAR)
            self._stream.flush()
        self._shown = ""

    def _words(self, service: "Service", now_s: float) -> str:
        status = service.running_status
        if status is not None and not self._is_ready:
            self._is_ready, self._began_s = True, now_s
        seconds = now_s - self._began_s
        if status is not None:
            return f"{seconds:.0f} s | {status}"
        if share := service.kernels_compiled:
            return f"compiling kernels {bar(share)} {seconds:.0f} s"
        return f"loading kernels, {seconds:.0f} s" if self._terminal or seconds > PLAIN_S else ""

    def _draw(self) -> None:
        """Back in the first column: the lines of other processes begin there."""
        if self._shown:
            self._stream.write(f"{CLEAR}{self._shown}\r")
            self._stream.flush()


@contextmanager
def status_line(stream: TextIO | None = None) -> Iterator[StatusLine]:
    """A StatusLine below which nothing is logged."""
    stream = sys.stderr if stream is None else stream
    line = StatusLine(stream)
    handlers: list[Any] = [
        handler
        for handler in logging.getLogger().handlers
        if isinstance(handler, logging.StreamHandler) and handler.stream is stream
    ]
    for handler in handlers:
        handler.setStream(cast("TextIO", line))
    try:
        yield line
    finally:
        for handler in handlers:
            handler.setStream(stream)
        line.end()
