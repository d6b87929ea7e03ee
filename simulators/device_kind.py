"""What `corridor simulate` knows of a type of fake device."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drivers.section import Section
from simulators.truth import Ride
from simulators.wire import PtyWire, TcpWire

if TYPE_CHECKING:  # it brings Zenoh, which no other device needs
    from simulators.zenoh_wire import ZenohWire


class DeviceOptions(Section, allow_inf_nan=False):
    """What may stand behind NAME=TYPE: as key=value. Every key has a default."""


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """options stand behind NAME=TYPE: as key=value; all have defaults.

    build takes the device's name, its options, the ride that feeds it and the seed of all noise, and gives
    the device on its wire, which is served while it is entered.
    """

    options: type[DeviceOptions]
    build: Callable[[str, Any, Ride, int], "TcpWire | PtyWire | ZenohWire"]
