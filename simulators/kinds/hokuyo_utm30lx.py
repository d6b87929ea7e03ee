"""The pretended Hokuyo laser as a type of device: its options, and how it comes to its wire."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.hokuyo_utm30lx.models import ModelName
from drivers.mounting import OffsetM, TurnDeg
from service.geometry.se2 import SE2
from simulators.device_kind import DeviceKind, DeviceOptions
from simulators.hokuyo_setup import REPLIES, Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.truth import URG04LX, UST, UTM30LX, LaserTruth, Ride, seed_of
from simulators.wire import PtyWire, TcpWire

OPTICS = {"utm_30lx": UTM30LX, "ust": UST, "urg_04lx_ug01": URG04LX}


class Utm30lxOptions(DeviceOptions):
    """What may stand behind `hokuyo_utm30lx:`."""

    model: ModelName = "utm_30lx"
    product: str = Field(default="", max_length=64)  # what it calls itself; "": as its model does
    wire: Literal["usb", "ethernet"] | None = None  # a terminal, or a TCP port; None: the first its model has
    link: Path | None = None  # usb: a symbolic link to the terminal, a name that stays
    host: str = "127.0.0.1"  # ethernet
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: OffsetM = 0.20  # mounting in the base frame
    y_m: OffsetM = 0.0
    yaw_deg: TurnDeg = 0.0
    sigma_m: float | None = Field(default=None, ge=0.0)  # None: the model's
    bias_m: float = 0.0
    clock_drift_ppm: float = 40.0
    motor_speed: float = Field(default=1.0, ge=0.9, le=1.1)  # of the nominal
    refuses: Literal["", "ME", "ND", "NE", "cluster", "skip"] = ""  # a command, or a part of all

    @model_validator(mode="after")
    def _model_has_the_wire(self) -> Self:
        if self.wire is not None and (self.model, self.wire) not in REPLIES:
            raise ValueError(f"model {self.model} has no wire {self.wire}")
        return self


def build(name: str, options: Utm30lxOptions, ride: Ride, seed: int) -> TcpWire | PtyWire:
    mounting = SE2(options.x_m, options.y_m, math.radians(options.yaw_deg))
    optics = replace(OPTICS[options.model], bias_m=options.bias_m)
    if options.sigma_m is not None:
        optics = replace(optics, sigma_m=options.sigma_m)
    source = LaserTruth(ride, name, mounting, optics, seed)
    wire = options.wire or ("usb" if (options.model, "usb") in REPLIES else "ethernet")
    setup = Utm30lxSetup(
        wire,
        options.model,
        options.product,
        clock_drift_ppm=options.clock_drift_ppm,
        motor_speed=options.motor_speed,
        refused=frozenset(filter(None, (options.refuses,))),
    )
    device = FakeUtm30lx(source, setup, seed_of(seed, name))
    if wire == "usb":
        return PtyWire(device, options.link)
    return TcpWire(device, options.host, options.port)


KIND = DeviceKind(Utm30lxOptions, build)
