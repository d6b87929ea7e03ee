"""Sensor types by name: the config, the wire and the session of each. One line per sensor."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from pydantic import BaseModel

from drivers.advice import NO_ADVICE, Advice
from drivers.hokuyo_utm30lx.advice import ADVICE as UTM30LX_ADVICE
from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.hokuyo_utm30lx.port import open_port as open_utm30lx_port
from drivers.ibeo_lux.advice import ADVICE as IBEO_LUX_ADVICE
from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.port import open_port as open_ibeo_lux_port
from drivers.ibeo_lux.port import session_maker as ibeo_lux_session_maker
from drivers.irobot_create.advice import ADVICE as IROBOT_CREATE_ADVICE
from drivers.irobot_create.config import IrobotCreateConfig
from drivers.irobot_create.driver import session_maker as irobot_create_session_maker
from drivers.irobot_create.port import open_port as open_irobot_create_port
from drivers.link import Session
from drivers.sick_lms100.advice import ADVICE as LMS100_ADVICE
from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.driver import Lms100Session
from drivers.transport import TcpTransport, Transport
from drivers.xsens_mtig.advice import ADVICE as XSENS_MTIG_ADVICE
from drivers.xsens_mtig.config import XsensMtigConfig
from drivers.xsens_mtig.driver import XsensMtigSession
from drivers.xsens_mtig.port import open_port as open_xsens_mtig_port


@dataclass(frozen=True, slots=True)
class SensorKind:
    """How to talk to one type of sensor. The callables take the sensor's own config model.

    `session_maker` is called once a sensor; what it returns, once a connection. What has to outlive
    a connection (the pose that wheels have added up) lives in between. `advice` is for `corridor doctor`.
    A `laser` gives LaserScans.
    """

    config: type[BaseModel]
    open_transport: Callable[[Any], Transport]
    session_maker: Callable[[Any], Callable[[], Session]]
    advice: Advice = NO_ADVICE
    laser: bool = False


SENSOR_KINDS: dict[str, SensorKind] = {
    "sick_lms100": SensorKind(
        Lms100Config,
        lambda c: TcpTransport(c.host, c.port),
        lambda c: partial(Lms100Session, c),
        LMS100_ADVICE,
        laser=True,
    ),
    "hokuyo_utm30lx": SensorKind(
        HokuyoUtm30lxConfig,
        open_utm30lx_port,
        lambda c: partial(HokuyoUtm30lxSession, c),
        UTM30LX_ADVICE,
        laser=True,
    ),
    "irobot_create": SensorKind(
        IrobotCreateConfig, open_irobot_create_port, irobot_create_session_maker, IROBOT_CREATE_ADVICE
    ),
    "ibeo_lux": SensorKind(
        IbeoLuxConfig, open_ibeo_lux_port, ibeo_lux_session_maker, IBEO_LUX_ADVICE, laser=True
    ),
    "xsens_mtig": SensorKind(
        XsensMtigConfig, open_xsens_mtig_port, lambda c: partial(XsensMtigSession, c), XSENS_MTIG_ADVICE
    ),
}
