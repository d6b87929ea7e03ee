"""Sensor types by name: the config, the wire and the session of each. One function per sensor.

What a sensor stands on is imported when its type is asked for: a start needs two types of five.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from pydantic import BaseModel

from drivers.advice import NO_ADVICE, Advice
from drivers.link import Session
from drivers.transport import TcpTransport, Transport


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


def _sick_lms100() -> SensorKind:
    from drivers.sick_lms100.advice import ADVICE
    from drivers.sick_lms100.config import Lms100Config
    from drivers.sick_lms100.driver import Lms100Session

    return SensorKind(
        Lms100Config,
        lambda c: TcpTransport(c.host, c.port),
        lambda c: partial(Lms100Session, c),
        ADVICE,
        laser=True,
    )


def _hokuyo_utm30lx() -> SensorKind:
    from drivers.hokuyo_utm30lx.advice import ADVICE
    from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
    from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
    from drivers.hokuyo_utm30lx.port import open_port

    return SensorKind(
        HokuyoUtm30lxConfig, open_port, lambda c: partial(HokuyoUtm30lxSession, c), ADVICE, laser=True
    )


def _irobot_create() -> SensorKind:
    from drivers.irobot_create.advice import ADVICE
    from drivers.irobot_create.config import IrobotCreateConfig
    from drivers.irobot_create.driver import session_maker
    from drivers.irobot_create.port import open_port

    return SensorKind(IrobotCreateConfig, open_port, session_maker, ADVICE)


def _ibeo_lux() -> SensorKind:
    from drivers.ibeo_lux.advice import ADVICE
    from drivers.ibeo_lux.config import IbeoLuxConfig
    from drivers.ibeo_lux.port import open_port, session_maker

    return SensorKind(IbeoLuxConfig, open_port, session_maker, ADVICE, laser=True)


def _xsens_mtig() -> SensorKind:
    from drivers.xsens_mtig.advice import ADVICE
    from drivers.xsens_mtig.config import XsensMtigConfig
    from drivers.xsens_mtig.driver import XsensMtigSession
    from drivers.xsens_mtig.port import open_port

    return SensorKind(XsensMtigConfig, open_port, lambda c: partial(XsensMtigSession, c), ADVICE)


class _Kinds(Mapping[str, SensorKind]):
    """Each kind is made once, when it is first looked up; asking whether a type is there makes none."""

    def __init__(self, makers: dict[str, Callable[[], SensorKind]]) -> None:
        self._makers = makers
        self._made: dict[str, SensorKind] = {}

    def __getitem__(self, name: str) -> SensorKind:
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]

    def __contains__(self, name: object) -> bool:
        return name in self._makers

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


SENSOR_KINDS: Mapping[str, SensorKind] = _Kinds(
    {
        "sick_lms100": _sick_lms100,
        "hokuyo_utm30lx": _hokuyo_utm30lx,
        "irobot_create": _irobot_create,
        "ibeo_lux": _ibeo_lux,
        "xsens_mtig": _xsens_mtig,
    }
)
