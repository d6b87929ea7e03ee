"""Bytes over a wire. The only module of drivers that opens sockets and ports."""

import errno
import os
import select
import socket
import termios
import time
from contextlib import suppress
from typing import Protocol, Self

import serial

from drivers.counted import counted
from drivers.errors import TransportError

READ_BYTES = 65_536
CONNECT_TIMEOUT_S = 1.5
DEAD_PEER_MS = 3_000  # unacknowledged data older than this means the cable is out
WRITE_TIMEOUT_S = 3.0  # a request of 100 bytes takes 0.2 s at 4800 baud
# What pyserial raises when a port disappears. termios.error is no OSError.
PORT_ERRORS = (serial.SerialException, OSError, termios.error, TypeError, ValueError)


def _reason(error: BaseException) -> str:
    """Error text of the system, without its number and the port, which pyserial repeats."""
    if isinstance(error, serial.SerialException) and error.errno is None and error.__context__ is not None:
        return _reason(error.__context__)  # of a URL: it quotes it
    number = error.errno if isinstance(error, OSError) else None
    if isinstance(error, termios.error):
        number = error.args[0]
        if number == errno.ENOTTY:
            return "it is no serial port"
    if isinstance(error, serial.SerialException) and number == errno.EWOULDBLOCK:  # locked by another process
        return "another program has it open"
    if number is None or isinstance(error, socket.gaierror):  # whose numbers are not the system's
        return getattr(error, "strerror", None) or str(error)
    return os.strerror(number)


class Transport(Protocol):
    """One open wire, closed at the end of a `with`. read() returns b"" when nothing came within timeout_s."""

    def read(self, timeout_s: float) -> bytes: ...
    def write(self, data: bytes) -> None: ...
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


class TcpTransport(Transport):
    """A TCP client. Raises TransportError when the peer refuses, resets, closes or stops acknowledging."""

    def __init__(self, host: str, port: int) -> None:
        self._where = f"{host}:{port}"
        try:
            self._socket = socket.create_connection((host, port), timeout=CONNECT_TIMEOUT_S)
        except (OSError, UnicodeError) as error:  # the latter of an invalid name
            raise TransportError(f"cannot connect to {self._where}: {_reason(error)}") from error
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in (
            *((socket.TCP_NODELAY, 1), (socket.TCP_USER_TIMEOUT, DEAD_PEER_MS)),
            *((socket.TCP_KEEPIDLE, 2), (socket.TCP_KEEPINTVL, 1), (socket.TCP_KEEPCNT, 3)),
        ):
            self._socket.setsockopt(socket.IPPROTO_TCP, option, value)

    def read(self, timeout_s: float) -> bytes:
        try:
            self._socket.settimeout(timeout_s)
            data = self._socket.recv(READ_BYTES)
        except TimeoutError:
            return b""
        except OSError as error:
            raise TransportError(f"{self._where}: {_reason(error)}") from error
        if not data:
            raise TransportError(f"{self._where} closed the connection")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._socket.settimeout(DEAD_PEER_MS / 1000)
            self._socket.sendall(data)
        except OSError as error:
            raise TransportError(
                f"{self._where}: cannot send {counted(len(data), 'byte')}: {_reason(error)}"
            ) from error

    def close(self) -> None:
        self._socket.close()


class SerialTransport(Transport):
    """A serial port by path, or socket://host:port of a device server; 8N1, no handshake.

    Raises TransportError where it cannot be opened, is unplugged, or takes nothing for WRITE_TIMEOUT_S.
    """

    def __init__(self, device: str, baud: int) -> None:
        self._where = f"{device} at {baud} baud"
        try:
            if "://" in device:
                self._port = serial.serial_for_url(device, baudrate=baud, timeout=0)
            else:
                self._port = serial.Serial(device, baud, timeout=0, exclusive=True)
        except PORT_ERRORS as error:
            raise TransportError(f"cannot open {self._where}: {_reason(error)}") from error
        try:
            self._port.fileno()
        except OSError as error:
            self._port.close()
            raise TransportError(
                f"cannot open {self._where}: such a port cannot be polled; write socket://host:port, and "
                "set the device server to raw TCP"
            ) from error

    def read(self, timeout_s: float) -> bytes:
        try:
            ready, _, _ = select.select([self._port.fileno()], [], [], timeout_s)
            if not ready:
                return b""
            data = (
                self._port.read(READ_BYTES)
                if "://" in self._where
                else os.read(self._port.fileno(), READ_BYTES)
            )
        except PORT_ERRORS as error:
            raise TransportError(f"{self._where}: {_reason(error)}; unplugged?") from error
        if not data:
            raise TransportError(f"{self._where}: readable but empty; unplugged?")
        return bytes(data)

    def write(self, data: bytes) -> None:
        # Not by pyserial, which retries without end and without a pause where a port takes nothing.
        left = memoryview(data)
        deadline_s = time.monotonic() + WRITE_TIMEOUT_S
        try:
            while left:
                wait_s = deadline_s - time.monotonic()
                if wait_s <= 0.0 or not select.select([], [self._port.fileno()], [], wait_s)[1]:
                    raise TransportError(
                        f"{self._where}: took {len(data) - len(left)} of {counted(len(data), 'byte')} within "
                        f"{WRITE_TIMEOUT_S:g} s; does the device hang? cut its power once"
                    )
                with suppress(BlockingIOError):
                    left = left[os.write(self._port.fileno(), left) :]
        except PORT_ERRORS as error:
            raise TransportError(
                f"{self._where}: cannot send {counted(len(data), 'byte')}: {_reason(error)}"
            ) from error

    def set_baud(self, baud: int) -> None:
        """Change the baud rate. Raises TransportError where the port cannot do it."""
        try:
            self._port.baudrate = baud
        except PORT_ERRORS as error:
            raise TransportError(f"{self._where}: cannot go to {baud} baud: {_reason(error)}") from error

    def set_low_latency(self) -> None:
        """Have a USB adapter hand over bytes at once, not every 16 ms; other ports ignore it."""
        try:
            self._port.set_low_latency_mode(True)
        except (AttributeError, NotImplementedError, OSError, ValueError):  # pyserial: not on this system
            return

    def set_wake_line(self, low: bool) -> None:
        """Pull RTS and DTR, which iRobot cables wire to BRC; ports without modem lines (pty) ignore it."""
        try:
            self._port.rts = self._port.dtr = low
        except PORT_ERRORS:
            return

    def close(self) -> None:
        self._port.close()
