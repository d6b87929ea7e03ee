"""The SICK scanners as a type of sensor: sessions over TCP."""

from functools import partial

from drivers.sensor_kind import SensorKind
from drivers.sick_lms100.advice import ADVICE
from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.driver import Lms100Session
from drivers.transport import TcpTransport


def open_port(config: Lms100Config) -> TcpTransport:
    """Raises TransportError."""
    return TcpTransport(config.host, config.port)


KIND = SensorKind(Lms100Config, open_port, lambda config: partial(Lms100Session, config), ADVICE, laser=True)
