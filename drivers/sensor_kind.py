"""What the service has to know of a type of sensor to run it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from drivers.advice import NO_ADVICE, Advice
from drivers.link import Session
from drivers.transport import Transport


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
