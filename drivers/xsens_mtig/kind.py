"""The MTi-G as a type of sensor."""

from functools import partial

from drivers.sensor_kind import SensorKind
from drivers.xsens_mtig.advice import ADVICE
from drivers.xsens_mtig.config import XsensMtigConfig
from drivers.xsens_mtig.driver import XsensMtigSession
from drivers.xsens_mtig.port import open_port

KIND = SensorKind(XsensMtigConfig, open_port, lambda config: partial(XsensMtigSession, config), ADVICE)
