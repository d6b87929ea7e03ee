"""The LUX as a type of sensor: sessions over TCP that know the time of day, to set the device's clock."""

import time
from functools import partial

from drivers.ibeo_lux.advice import ADVICE
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.sensor_kind import SensorKind
from drivers.transport import TcpTransport


def open_port(config: IbeoLuxConfig) -> TcpTransport:
    """Raises TransportError."""
    return TcpTransport(config.host, config.port)


KIND = SensorKind(
    IbeoLuxConfig, open_port, lambda config: partial(IbeoLuxSession, config, time.time_ns), ADVICE, laser=True
)
