"""The wire to the device: TCP."""

from drivers.sick_lms100.config import Lms100Config
from drivers.transport import TcpTransport


def open_port(config: Lms100Config) -> TcpTransport:
    """Raises TransportError where it cannot be opened."""
    return TcpTransport(config.host, config.port)
