"""The wire to the device: a USB port that is a CDC-ACM terminal, or TCP."""

from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.transport import SerialTransport, TcpTransport, Transport

BAUD = 115_200  # means nothing on USB, but a terminal must have one


def open_port(config: HokuyoUtm30lxConfig) -> Transport:
    """Raises TransportError where it cannot be opened."""
    if config.device is not None:
        return SerialTransport(config.device, BAUD)
    assert config.host is not None
    return TcpTransport(config.host, config.port)
