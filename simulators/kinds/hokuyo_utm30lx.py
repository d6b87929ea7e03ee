"""The pretended UTM-30LX as a type of device: its options, and how it comes to its wire."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from drivers.mounting import OffsetM, TurnDeg
from service.geometry.se2 import SE2
from simulators.device_kind import DeviceKind
from simulators.hokuyo_utm30lx import FakeUtm30lx, Utm30lxSetup
from simulators.truth import UTM30LX, LaserTruth, Ride, seed_of
from simulators.wire import PtyWire, TcpWire, serve_pty, serve_tcp


class Utm30lxOptions(BaseModel):
    """What may stand behind `hokuyo_utm30lx:`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    wire: Literal["usb", "ethernet"] = "usb"  # UTM-30LX on a terminal; UTM-30LX-EW on a TCP port
    link: Path | None = None  # usb: a symbolic link to the terminal, a name that stays
    host: str = "127.0.0.1"  # ethernet
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: OffsetM = 0.20  # mounting in the base frame
    y_m: OffsetM = 0.0
    yaw_deg: TurnDeg = 0.0
    sigma_m: float = Field(default=UTM30LX.sigma_m, ge=0.0)
    bias_m: float = UTM30LX.bias_m
    clock_drift_ppm: float = 40.0
    motor_speed: float = Field(default=1.0, ge=0.9, le=1.1)  # of 40 turns a second
    refuses: Literal["", "ME", "ND", "NE", "cluster", "skip"] = ""  # a command, or a part of all


def build(name: str, options: Utm30lxOptions, ride: Ride, seed: int) -> TcpWire | PtyWire:
    mounting = SE2(options.x_m, options.y_m, math.radians(options.yaw_deg))
    model = replace(UTM30LX, sigma_m=options.sigma_m, bias_m=options.bias_m)
    source = LaserTruth(ride, name, mounting, model, seed)
    setup = Utm30lxSetup(
        options.wire,
        clock_drift_ppm=options.clock_drift_ppm,
        motor_speed=options.motor_speed,
        refused=frozenset(filter(None, (options.refuses,))),
    )
    device = FakeUtm30lx(source, setup, seed_of(seed, name))
    if options.wire == "usb":
        return serve_pty(device, options.link)
    return serve_tcp(device, options.host, options.port)


KIND = DeviceKind(Utm30lxOptions, build)
