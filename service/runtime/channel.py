"""Messages between two processes over a Unix socket; sending never waits, and no thread is needed.

What the socket does not take at once waits here and goes out with the next `send` or `flush`. A process
without threads can be forked, which is what the mapper's stand-by rests on (see mapper_process.py).
"""

import pickle
import select
import socket
import struct
import threading
import time
from collections.abc import Collection
from typing import Any, Protocol

_SIZE = struct.Struct("<I")
_READ_BYTES = 1 << 18
BUFFER_BYTES = 1 << 20  # requested from the system, which may give less
MAX_WAITING_BYTES = 256 << 20  # of a reader that stands still


class ChannelClosedError(Exception):
    """The other side has closed the connection."""


class End(Protocol):
    """Objects that wait_for can wait for."""

    @property
    def waiting_bytes(self) -> int: ...

    def fileno(self) -> int: ...
    def flush(self) -> bool: ...


class Channel:
    """One end of a connection. `send` and `flush` from any thread, `receive` from one.

    Messages are any objects that can be pickled; they come in the order in which they were sent, and
    complete.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        for buffer in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            connection.setsockopt(socket.SOL_SOCKET, buffer, BUFFER_BYTES)
        self._socket = connection
        self._lock = threading.Lock()  # of what waits
        self._waiting = bytearray()
        self._read = bytearray()

    def fileno(self) -> int:
        return self._socket.fileno()

    @property
    def waiting_bytes(self) -> int:
        """Number of bytes that the other side has not taken yet."""
        return len(self._waiting)

    def send(self, *messages: Any) -> None:
        """Never waits. Raises ChannelClosedError, also where the other side has long stopped to read."""
        parts = []
        for message in messages:
            body = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
            parts += [_SIZE.pack(len(body)), body]
        with self._lock:
            if len(self._waiting) > MAX_WAITING_BYTES:
                raise ChannelClosedError(f"{len(self._waiting)} bytes wait; the other side stands still")
            if self._waiting:
                self._waiting += b"".join(parts)
                self._flush()
                return
            sent = self._write(parts)
            if sent < sum(map(len, parts)):
                self._waiting += b"".join(parts)[sent:]

    def flush(self) -> bool:
        """Send what waits, as far as the socket takes it; True if all is sent. Raises ChannelClosedError."""
        with self._lock:
            self._flush()
            return not self._waiting

    def receive(self) -> list[Any]:
        """All messages that are there completely; does not wait. Raises ChannelClosedError after the last."""
        ended = ""
        while not ended:
            try:
                data = self._socket.recv(_READ_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                ended = str(error)
                break
            if not data:
                ended = "the other side has ended"
            self._read += data
            if len(data) < _READ_BYTES:
                break
        messages = self._take_complete()  # what came before the end is handed out first
        if ended and not messages:
            raise ChannelClosedError(ended)
        return messages

    def wait(self, timeout_s: float) -> bool:
        """Until something can be read, or the other side is gone; sends meanwhile. False when time is up."""
        return self in wait_for((self,), timeout_s)

    def receive_within(self, timeout_s: float) -> list[Any]:
        """As `receive`, but waits for a message; empty when none came in time. Raises ChannelClosedError."""
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0.0 and self.wait(left_s):
            if messages := self.receive():
                return messages
        return []

    def close(self) -> None:
        self._socket.close()

    def _take_complete(self) -> list[Any]:
        messages = []
        at = 0
        with memoryview(self._read) as view:
            while len(view) - at >= _SIZE.size:
                (size,) = _SIZE.unpack_from(view, at)
                end = at + _SIZE.size + size
                if end > len(view):
                    break
                messages.append(pickle.loads(view[at + _SIZE.size : end]))
                at = end
        del self._read[:at]
        return messages

    def _flush(self) -> None:
        while self._waiting:
            sent = self._write([bytes(self._waiting[:_READ_BYTES])])
            if sent == 0:
                return
            del self._waiting[:sent]

    def _write(self, parts: Collection[bytes]) -> int:
        try:
            return self._socket.sendmsg(parts)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise ChannelClosedError(str(error)) from error


class Listening:
    """Lets a listening socket be waited for beside channels."""

    waiting_bytes = 0

    def __init__(self, server: socket.socket) -> None:
        self._server = server

    def fileno(self) -> int:
        return self._server.fileno()

    def flush(self) -> bool:
        return True


def wait_for(channels: Collection[End], timeout_s: float) -> list[End]:
    """The ends that can be read, or whose other side has closed; meanwhile waiting data is sent."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        poll = select.poll()
        by_number = {}
        for channel in channels:
            by_number[channel.fileno()] = channel
            poll.register(channel.fileno(), select.POLLIN | (select.POLLOUT if channel.waiting_bytes else 0))
        left_s = max(deadline_s - time.monotonic(), 0.0)
        ready = []
        for number, events in poll.poll(left_s * 1e3):
            end = by_number[number]
            is_over = False
            if events & select.POLLOUT and not events & ~select.POLLOUT:
                try:
                    end.flush()
                except ChannelClosedError:
                    is_over = True  # the next `receive` raises it
            if events & ~select.POLLOUT or is_over:
                ready.append(end)
        if ready or time.monotonic() >= deadline_s:
            return ready
