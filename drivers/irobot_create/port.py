"""The robot's serial port with its wake line: BRC, which iRobot and most other cables tie to RTS or DTR."""

import time
from collections.abc import Callable

from drivers.irobot_create.config import IrobotCreateConfig
from drivers.transport import SerialTransport, Transport

# One pulse wakes a sleeping robot; three within 2 s of power-on would switch it to 19200 baud. One second low
# a minute keeps it from going to sleep after five (Create 2 Open Interface 2016, pin 5 of the connector).
WAKE_AT_S, WAKE_S = 0.2, 0.6
KEEP_AWAKE_EVERY_S, KEEP_AWAKE_S = 60.0, 1.0


def wake_line_low(open_since_s: float) -> bool:
    """Whether BRC is to be low so long after the port was opened."""
    if open_since_s < KEEP_AWAKE_EVERY_S:
        return WAKE_AT_S <= open_since_s < WAKE_AT_S + WAKE_S
    return open_since_s % KEEP_AWAKE_EVERY_S < KEEP_AWAKE_S


class WakingPort(SerialTransport):
    """A serial port that pulses the wake line while it is being read. Raises TransportError as its base."""

    def __init__(self, device: str, baud: int, now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__(device, baud)
        self._now_s = now_s
        self._opened_s = now_s()
        self._low = False
        self.set_wake_line(False)  # opening a port pulls both lines

    def read(self, timeout_s: float) -> bytes:
        low = wake_line_low(self._now_s() - self._opened_s)
        if low != self._low:
            self._low = low
            self.set_wake_line(low)
        return super().read(timeout_s)


def open_port(config: IrobotCreateConfig) -> Transport:
    """The wire to the robot. Raises TransportError where it cannot be opened."""
    if config.wake_line:
        return WakingPort(config.device, config.baud)
    return SerialTransport(config.device, config.baud)
