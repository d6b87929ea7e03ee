"""Create and Roomba as a type of sensor."""

from drivers.irobot_create.advice import ADVICE
from drivers.irobot_create.config import IrobotCreateConfig
from drivers.irobot_create.driver import session_maker
from drivers.irobot_create.port import open_port
from drivers.sensor_kind import SensorKind

KIND = SensorKind(IrobotCreateConfig, open_port, session_maker, ADVICE)
