"""A type of fake device, for `corridor simulate`."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pydantic import Field

from drivers.mounting import OffsetM, TurnDeg
from drivers.section import Section
from service.geometry.se2 import SE2
from simulators.truth import LaserModel, LaserTruth, Ride
from simulators.wire import PtyWire, TcpWire

if TYPE_CHECKING:  # it brings Zenoh, which no other device needs
    from simulators.zenoh_wire import ZenohWire


class DeviceOptions(Section, allow_inf_nan=False):
    """Options after NAME=TYPE: as key=value. Every key has a default."""


class MountedOptions(DeviceOptions):
    """Options of a device with a mounting in the base frame, and a clock of its own."""

    x_m: OffsetM = 0.0
    y_m: OffsetM = 0.0
    yaw_deg: TurnDeg = 0.0
    clock_drift_ppm: float = 40.0

    @property
    def yaw_rad(self) -> float:
        return math.radians(self.yaw_deg)


class LaserOptions(MountedOptions):
    """Options of a laser with a TCP port."""

    host: str = "127.0.0.1"
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: OffsetM = 0.20  # as in config/vehicle.yaml
    sigma_m: float | None = Field(default=None, ge=0.0)  # None: the model's
    bias_m: float = 0.0

    def source(self, ride: Ride, name: str, optics: LaserModel, seed: int) -> LaserTruth:
        sigma_m = optics.sigma_m if self.sigma_m is None else self.sigma_m
        model = replace(optics, sigma_m=sigma_m, bias_m=self.bias_m)
        return LaserTruth(ride, name, SE2(self.x_m, self.y_m, self.yaw_rad), model, seed)


@dataclass(frozen=True, slots=True)
class DeviceKind:
    """options follow NAME=TYPE: as key=value; all have defaults.

    build takes the device's name, its options, the ride that it measures and the seed of all noise, and
    returns the device on its wire, which is served while it is entered.
    """

    options: type[DeviceOptions]
    build: Callable[[str, Any, Ride, int], "TcpWire | PtyWire | ZenohWire"]
