"""Sensor types by name: the config, the wire and the session of each. One line per sensor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from drivers.irobot_create.config import IrobotCreateConfig
from drivers.irobot_create.driver import new_session as new_irobot_create_session
from drivers.irobot_create.port import open_port as open_irobot_create_port
from drivers.link import Session
from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.driver import Lms100Session
from drivers.transport import TcpTransport, Transport


@dataclass(frozen=True, slots=True)
class SensorKind:
    """How to talk to one type of sensor. The callables take the sensor's own config model."""

    config: type[BaseModel]
    open_transport: Callable[[Any], Transport]
    new_session: Callable[[Any], Session]


SENSOR_KINDS: dict[str, SensorKind] = {
    "sick_lms100": SensorKind(Lms100Config, lambda c: TcpTransport(c.host, c.port), Lms100Session),
    "irobot_create": SensorKind(IrobotCreateConfig, open_irobot_create_port, new_irobot_create_session),
}
