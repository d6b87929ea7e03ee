"""Puts a fake device on a real wire: a TCP port or a pseudo terminal, one thread each.

    wire = TcpWire(FakeLms100(...))
    with wire as (host, port):
        ...             # a driver connects, communicates, disconnects, connects again
        wire.cut()      # clients are reset and the port refuses, as at a loss of power
        wire.restore()  # the same port again

The wire knows no protocol. It hands bytes and the host's monotonic time to the device and writes what the
device returns, each return value with one write. A reader that is too slow loses complete messages, counted.
"""

import errno
import logging
import os
import select
import socket
import struct
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from simulators.device import FakeDevice, ManyClients, Unpluggable

log = logging.getLogger(__name__)

READ_BYTES = 65_536
BACKLOG_BYTES = 256 * 1024  # unsent bytes beyond which a slow reader loses messages
SEND_BUFFER_BYTES = 128 * 1024  # bytes that the kernel may buffer, TCP only
MESSAGES_A_ROUND = 32  # due() calls before the wire looks at its clients again
PTY_POLL_NS = 10_000_000  # how often a pseudo terminal without a client is polled
DROPPED = "messages_dropped_slow_reader"  # name of a counter
STOP_TIMEOUT_S = 5.0
RESET_ON_CLOSE = struct.pack("ii", 1, 0)  # SO_LINGER on, 0 s: RST instead of FIN


class _PeerGoneError(Exception):
    """The client has closed the connection."""


class _Client:
    """One open link: a descriptor, the device behind it, and what could not be written yet."""

    def __init__(self, fd: int, device: FakeDevice, counters: Counter[str]) -> None:
        self.fd = fd
        self.device = device
        self.unsent = bytearray()
        self._counters = counters

    def send(self, message: bytes) -> None:
        """Write now what the wire takes, keep the rest. Raises _PeerGoneError."""
        if not message:
            return
        if len(self.unsent) + len(message) > BACKLOG_BYTES:
            self._counters[DROPPED] += 1
            return
        self.unsent += message
        self.flush()

    def flush(self) -> None:
        try:
            written = os.write(self.fd, self.unsent)
        except BlockingIOError:
            return
        except OSError as error:
            raise _PeerGoneError from error
        self._counters["bytes_written"] += written
        del self.unsent[:written]

    def read(self) -> bytes | None:
        """The bytes received, b"" if there are none, None if the peer has disconnected."""
        try:
            return os.read(self.fd, READ_BYTES) or None
        except BlockingIOError:
            return b""
        except OSError:
            return None


class _Wire(ABC):
    """The loop both kinds share: wait for bytes or for the next due time, whichever is first."""

    def __init__(self, name: str, device: FakeDevice | ManyClients) -> None:
        self.name = name
        self.device = device  # may be replaced by one that wraps it until the wire is entered
        self.counters: Counter[str] = Counter()  # clients, refused, bytes, dropped; names are for people
        self.failure: BaseException | None = None  # what a device raised; it ends the wire
        self._clients: list[_Client] = []
        self._plug: Unpluggable | None = None
        self._thread: threading.Thread | None = None
        self._wake_read, self._wake_write = -1, -1

    def _start(self) -> None:
        self._wake_read, self._wake_write = os.pipe()
        self._plug = self.device if isinstance(self.device, Unpluggable) else None
        self._thread = threading.Thread(target=self._run, name=f"wire {self.name}", daemon=True)
        self._thread.start()

    def _stop(self) -> None:
        if self._thread is None:
            return
        os.write(self._wake_write, b"x")
        self._thread.join(STOP_TIMEOUT_S)
        if self._thread.is_alive():
            raise RuntimeError(f"{self.name}: wire thread still running {STOP_TIMEOUT_S} s after its stop")
        self._thread = None
        os.close(self._wake_read)
        os.close(self._wake_write)

    def restore(self) -> Self:
        """Open and serve, after a cut in the same place. Raises OSError where it is taken."""
        if self._thread is None:
            self._plug_in()
            self._start()
        return self

    def cut(self) -> None:
        """Unplug: clients get an error, and there is nothing to open until restore()."""
        self._stop()
        self._unplug()

    def close(self) -> None:
        """End for good. Raises what the device raised in the wire's thread, if it did."""
        self._stop()
        self._close_port()
        if self.failure is not None:
            failure, self.failure = self.failure, None
            raise failure

    @abstractmethod
    def _is_plugged(self) -> bool: ...

    @abstractmethod
    def _plug_in(self) -> None:
        """Does nothing where it is plugged in."""

    @abstractmethod
    def _unplug(self) -> None: ...

    @abstractmethod
    def _close_port(self) -> None:
        """Close the clients and the port."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self.failure = None
        self.close()

    def _run(self) -> None:
        try:
            while self._round():
                pass
        except BaseException as error:  # for close(), which raises it
            log.exception("%s: fake device failed", self.name)
            self.failure = error
            self._drop_all()

    def _round(self) -> bool:
        """One wait and what follows from it; False when requested to stop."""
        now_ns = time.monotonic_ns()
        if self._plug is not None and self._plug.plugged(now_ns) != self._is_plugged():
            if self._is_plugged():
                self._unplug()
            else:
                self._plug_in()
        due_ns = self._earliest_ns(now_ns)
        timeout_s = None if due_ns is None else max(0, due_ns - now_ns) * 1e-9
        reading = [self._wake_read, *self._listening(), *(client.fd for client in self._clients)]
        writing = [client.fd for client in self._clients if client.unsent]
        readable, writable, _ = select.select(reading, writing, [], timeout_s)
        if self._wake_read in readable:
            return False
        for client in list(self._clients):
            self._serve(client, client.fd in readable, client.fd in writable)
        self._accept_clients(readable)
        return True

    def _serve(self, client: _Client, readable: bool, writable: bool) -> None:
        try:
            if writable:
                client.flush()
            if readable and not self._receive(client):
                return
            for _ in range(MESSAGES_A_ROUND):
                now_ns = time.monotonic_ns()
                due_ns = client.device.next_due_ns(now_ns)
                if due_ns is None or due_ns > now_ns:
                    return
                client.send(client.device.due(now_ns))
        except _PeerGoneError:
            self._drop(client)

    def _receive(self, client: _Client) -> bool:
        """Read once and answer; False if the client has disconnected."""
        data = client.read()
        if data is None:
            self._drop(client)
            return False
        if data:
            self.counters["bytes_read"] += len(data)
            client.send(client.device.receive_data(data, time.monotonic_ns()))
        return True

    def _earliest_ns(self, now_ns: int) -> int | None:
        times = [client.device.next_due_ns(now_ns) for client in self._clients]
        if self._plug is not None:
            times.append(self._plug.next_plug_ns(now_ns))
        return min((due_ns for due_ns in times if due_ns is not None), default=None)

    def _admit(self, fd: int, device: FakeDevice) -> None:
        os.set_blocking(fd, False)
        client = _Client(fd, device, self.counters)
        self._clients.append(client)
        self.counters["clients"] += 1
        try:
            client.send(device.connected(time.monotonic_ns()))
        except _PeerGoneError:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        self._clients.remove(client)
        self._close_link(client.fd)
        client.device.disconnected(time.monotonic_ns())

    def _drop_all(self) -> None:
        for client in list(self._clients):
            self._drop(client)

    @abstractmethod
    def _listening(self) -> Sequence[int]:
        """Descriptors that become readable when a client connects."""

    @abstractmethod
    def _accept_clients(self, readable: Sequence[int]) -> None: ...

    @abstractmethod
    def _close_link(self, fd: int) -> None: ...


class TcpWire(_Wire):
    """A device behind a TCP port. A device that is one FakeDevice serves one client and refuses a second
    (accepted and closed at once); a ManyClients device gives each client a FakeDevice of its own. Listens
    while it is entered, which gives (host, port). Port 0: any free one.
    """

    def __init__(self, device: FakeDevice | ManyClients, host: str = "127.0.0.1", port: int = 0) -> None:
        super().__init__(f"tcp {host}:{port}", device)
        self.endpoint = (host, port)  # for port 0 the real one, once entered
        self._server: socket.socket | None = None

    def __enter__(self) -> tuple[str, int]:
        self.restore()
        return self.endpoint

    def _is_plugged(self) -> bool:
        return self._server is not None

    def _plug_in(self) -> None:
        if self._server is None:
            self._server = socket.create_server(self.endpoint)
            self._server.setblocking(False)
            self.endpoint = self._server.getsockname()[:2]
            self.name = f"tcp {self.endpoint[0]}:{self.endpoint[1]}"

    def _unplug(self) -> None:
        """Reset every client and stop listening: a new connection is refused."""
        for client in self._clients:
            with socket.socket(fileno=os.dup(client.fd)) as link:
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET_ON_CLOSE)
        self._close_port()

    def _close_port(self) -> None:
        if self._server is not None:  # first, so that no dropped client can connect again
            self._server.close()
            self._server = None
        self._drop_all()

    def _listening(self) -> Sequence[int]:
        return [] if self._server is None else [self._server.fileno()]

    def _accept_clients(self, readable: Sequence[int]) -> None:
        if self._server is None or self._server.fileno() not in readable:
            return
        try:
            link, _ = self._server.accept()
        except OSError:  # it disconnected at once
            return
        device = self._device_for_new_client()
        if device is None:
            self.counters["clients_refused"] += 1
            link.close()
            return
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        self._admit(link.detach(), device)

    def _device_for_new_client(self) -> FakeDevice | None:
        if isinstance(self.device, ManyClients):
            return self.device.new_client()
        for client in list(self._clients):  # it may have disconnected just before: its FIN precedes this SYN
            for _ in range(MESSAGES_A_ROUND):
                if client not in self._clients or not select.select([client.fd], [], [], 0)[0]:
                    break
                self._serve(client, readable=True, writable=False)
        return self.device if not self._clients else None

    def _close_link(self, fd: int) -> None:
        os.close(fd)


class PtyWire(_Wire):
    """A device behind a pseudo terminal. Entering it gives the path; opening it connects,
    closing it disconnects.

    A pseudo terminal has no baud rate and no modem lines: any rate a driver sets is accepted. With `link`
    the path is a symbolic link that survives a cut, as a udev name does; without, restore() may bring
    another /dev/pts number.
    """

    def __init__(self, device: FakeDevice, link: Path | None = None) -> None:
        super().__init__("pty", device)
        self.link = link  # may be set until the wire is entered
        self._master = -1
        self._path = ""

    @property
    def endpoint(self) -> str:
        return str(self.link) if self.link is not None else self._path

    def __enter__(self) -> str:
        self.restore()
        return self.endpoint

    def _is_plugged(self) -> bool:
        return self._master >= 0

    def _plug_in(self) -> None:
        if self._master >= 0:
            return
        self._master, slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(slave)
        self._path = os.ttyname(slave)
        os.close(slave)  # so that the master detects whether a client has the slave open
        os.set_blocking(self._master, False)
        self.name = f"pty {self._path}"
        if self.link is not None:
            if self.link.is_symlink():  # of an earlier run; other files stay
                self.link.unlink()
            self.link.symlink_to(self._path)

    def _unplug(self) -> None:
        """The path disappears and a client that has it open reads an error."""
        self._close_port()

    def _close_port(self) -> None:
        self._drop_all()
        if self._master >= 0:
            os.close(self._master)
            self._master = -1
        if self.link is not None:
            self.link.unlink(missing_ok=True)

    def _earliest_ns(self, now_ns: int) -> int | None:
        return super()._earliest_ns(now_ns) if self._clients else now_ns + PTY_POLL_NS

    def _listening(self) -> Sequence[int]:
        return []

    def _accept_clients(self, readable: Sequence[int]) -> None:
        if not self._clients and self._is_plugged() and not self._hung_up():
            assert not isinstance(self.device, ManyClients), "a terminal has one client"
            self._admit(self._master, self.device)

    def _hung_up(self) -> bool:
        """Whether no client has the slave open."""
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        return any(events & select.POLLHUP for _, events in poll.poll(0))

    def _close_link(self, fd: int) -> None:
        """Unread bytes are lost, as on a real line: those in transit and those received."""
        try:
            line = os.open(self._path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # the line was cut
            return
        try:
            for end in (fd, line):
                termios.tcflush(end, termios.TCIOFLUSH)
        except termios.error as error:
            if error.args[0] != errno.EIO:
                raise
        finally:
            os.close(line)
