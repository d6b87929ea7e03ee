"""The UTM-30LX as a type of sensor."""

from functools import partial

from drivers.hokuyo_utm30lx.advice import ADVICE
from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.hokuyo_utm30lx.port import open_port
from drivers.sensor_kind import SensorKind

KIND = SensorKind(
    HokuyoUtm30lxConfig, open_port, lambda config: partial(HokuyoUtm30lxSession, config), ADVICE, laser=True
)
