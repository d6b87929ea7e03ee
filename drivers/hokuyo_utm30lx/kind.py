"""The Hokuyo lasers as a type of sensor: sessions over USB, where they are a CDC-ACM terminal, or TCP."""

from functools import partial

from drivers.hokuyo_utm30lx.advice import ADVICE
from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.sensor_kind import SensorKind
from drivers.transport import SerialTransport, TcpTransport, Transport

BAUD = 115_200  # means nothing on USB, but a terminal must have one


def open_port(config: HokuyoUtm30lxConfig) -> Transport:
    """Raises TransportError."""
    if config.device is not None:
        return SerialTransport(config.device, BAUD)
    assert config.host is not None
    return TcpTransport(config.host, config.port)


KIND = SensorKind(
    HokuyoUtm30lxConfig, open_port, lambda config: partial(HokuyoUtm30lxSession, config), ADVICE, laser=True
)
