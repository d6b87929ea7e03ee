"""Sensor types by name. One line per sensor: its module holds the config, the wire and the session of it."""

from collections.abc import Mapping

from drivers.lazy_registry import LazyRegistry
from drivers.sensor_kind import SensorKind

# In the order in which `corridor init` queries an unknown wire: at a serial port a robot before the unit
# whose bytes it might take for commands.
DRIVERS = {
    "sick_lms100": "drivers.sick_lms100.kind",
    "hokuyo_utm30lx": "drivers.hokuyo_utm30lx.kind",
    "irobot_create": "drivers.irobot_create.kind",
    "ibeo_lux": "drivers.ibeo_lux.kind",
    "xsens_mtig": "drivers.xsens_mtig.kind",
}
SENSOR_KINDS: Mapping[str, SensorKind] = LazyRegistry(SensorKind, DRIVERS)
