"""A type of sensor: its config, port and sessions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from drivers.advice import NO_ADVICE, Advice
from drivers.link import Session
from drivers.transport import Transport


@dataclass(frozen=True, slots=True)
class SensorKind:
    """Config, port and sessions of one type of sensor. The callables take its config model.

    `session_maker` is called once a sensor; what it returns, once a connection. What has to outlive
    a connection (the pose of wheels) belongs to what it returns. `advice` is for `corridor doctor`.
    A `laser` gives LaserScans.
    """

    config: type[BaseModel]
    open_transport: Callable[[Any], Transport]
    session_maker: Callable[[Any], Callable[[], Session]]
    advice: Advice = NO_ADVICE
    laser: bool = False
