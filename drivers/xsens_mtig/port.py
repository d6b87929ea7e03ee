"""The wire to the device: a serial port whose rate may have to be found, or USB."""

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from drivers.transport import SerialTransport, Transport
from drivers.usb_transport import UsbTransport
from drivers.xsens_mtig.config import AUTO, XsensMtigConfig
from drivers.xsens_mtig.protocol import LIKELY_BAUDS, MessageDecoder

VENDOR = 0x2639
# drivers/usb/serial/xsens_mt.c of Linux: MTi-10, 20, 30, 100, 200, 300, MTi-G-700 (and 710).
PRODUCTS = (0x0001, 0x0002, 0x0003, 0x0011, 0x0012, 0x0013, 0x0017)
DWELL_S = 0.6  # at each rate; the session sends GoToConfig three times in it


class BaudPort(Transport, Protocol):
    """A wire whose rate can be set while it is open."""

    def set_baud(self, baud: int) -> None: ...


class ProbingPort(Transport):
    """Changes the rate until a complete message comes. What is written goes
    out at the rate of the moment, so a request has to be repeated until it is answered.
    """

    def __init__(
        self, port: BaudPort, bauds: Sequence[int] = LIKELY_BAUDS, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._port = port
        self._bauds = bauds
        self._now_s = now_s
        self._index = 0
        self._since_s = now_s()
        self._decoder: MessageDecoder | None = MessageDecoder()  # None: the rate is known
        port.set_baud(bauds[0])

    @property
    def baud(self) -> int:
        return self._bauds[self._index]

    def read(self, timeout_s: float) -> bytes:
        if self._decoder is not None and self._now_s() - self._since_s > DWELL_S:
            self._index = (self._index + 1) % len(self._bauds)
            self._since_s = self._now_s()
            self._decoder = MessageDecoder()
            self._port.set_baud(self.baud)
        data = self._port.read(timeout_s)
        if self._decoder is not None and self._decoder.receive_data(data):
            self._decoder = None
        return data

    def write(self, data: bytes) -> None:
        self._port.write(data)

    def close(self) -> None:
        self._port.close()


def open_port(config: XsensMtigConfig) -> Transport:
    """Raises TransportError where it cannot be opened."""
    if config.over_usb:
        return UsbTransport(VENDOR, PRODUCTS, config.usb_serial)
    port = SerialTransport(config.device, LIKELY_BAUDS[0] if config.baud == AUTO else config.baud)
    port.set_low_latency()
    return ProbingPort(port) if config.baud == AUTO else port
