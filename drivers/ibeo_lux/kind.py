"""The LUX as a type of sensor."""

from drivers.ibeo_lux.advice import ADVICE
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.port import open_port, session_maker
from drivers.sensor_kind import SensorKind

KIND = SensorKind(IbeoLuxConfig, open_port, session_maker, ADVICE, laser=True)
