"""Hints on a type of sensor for `corridor doctor` and `corridor init`, besides its config, port and session.

It is optional, in drivers/<sensor>/advice.py, and so is each of its fields: a sensor
without advice is examined by its session alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

DIFFERENCE = (
    "configured"  # in a status: what the device does otherwise than configured, and is used all the same
)


class OtherSettings(NamedTuple):
    """A config to try where nothing answers, and the settings that make it: `dialect: cola_b`."""

    words: str
    config: Any


@dataclass(frozen=True, slots=True)
class Advice:
    """The callables take the sensor's own config model.

    name            of the first such sensor in a config that `corridor init` writes; "": its type
    at_host         settings with which `corridor init` looks for this sensor at a host; None: it does not
    at_port         the same of a serial port
    rate_hz         frames a second that the config requests, None where unknown
    recognise       which device sends these bytes, as text; "" where it is not this type of sensor. Raises
                    nothing for any bytes up to 16 KiB
    bauds           baud rates that this sensor may be set to; empty where a rate means nothing
    other_settings  tried in turn where nothing answers; each takes a start-up dialogue of the driver
    doubt           why this is not the device the config means, from its identity; "" where it may be
    settings_of     settings that the identity shows: {"model": "lms5xx"}; empty where it shows none
    worries         words in a status beside "streaming" that call for action
    start_up_s      how long the first frame may take where nothing is wrong
    silence         what to do about a device that sends nothing
    """

    name: str = ""
    at_host: Mapping[str, Any] | None = None
    at_port: Mapping[str, Any] | None = None
    rate_hz: Callable[[Any], float | None] = lambda config: None
    recognise: Callable[[bytes], str] = lambda data: ""
    bauds: tuple[int, ...] = ()
    other_settings: Callable[[Any], Sequence[OtherSettings]] = lambda config: ()
    doubt: Callable[[Any, Mapping[str, str]], str] = lambda config, identity: ""
    settings_of: Callable[[Mapping[str, str]], Mapping[str, Any]] = lambda identity: {}
    worries: tuple[str, ...] = ()
    start_up_s: float = 12.0
    silence: str = "is it switched on, has it finished booting, is the cable in, does another host hold it?"


NO_ADVICE = Advice()
