"""The wire to the device: TCP. Its sessions get the time of day, to set the device's clock."""

import time
from collections.abc import Callable
from functools import partial

from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.transport import TcpTransport


def open_port(config: IbeoLuxConfig) -> TcpTransport:
    """Raises TransportError."""
    return TcpTransport(config.host, config.port)


def session_maker(config: IbeoLuxConfig) -> Callable[[], IbeoLuxSession]:
    """Called once a sensor; what it returns, once a connection."""
    return partial(IbeoLuxSession, config, time.time_ns)
