"""The pretended SICK scanner as a type of device: its options, and how it comes to its wire."""

import math
from dataclasses import replace
from typing import Literal

from pydantic import Field

from drivers.mounting import OffsetM, TurnDeg
from drivers.sick_lms100.models import ModelName
from service.geometry.se2 import SE2
from simulators.device_kind import DeviceKind, DeviceOptions
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from simulators.truth import LMS100, LMS500, TIM500, LaserTruth, Ride, seed_of
from simulators.wire import TcpWire

OPTICS = {"lms1xx": LMS100, "lms5xx": LMS500, "tim5xx": TIM500, "tim7xx": TIM500}


class Lms100Options(DeviceOptions):
    """What may stand behind `sick_lms100:`."""

    model: ModelName = "lms1xx"
    ident: str = Field(default="", max_length=32)  # what it calls itself; "": as its model does
    host: str = "127.0.0.1"
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: OffsetM = 0.20  # mounting in the base frame, as in config/vehicle.yaml
    y_m: OffsetM = 0.0
    yaw_deg: TurnDeg = 0.0
    sigma_m: float | None = Field(default=None, ge=0.0)  # None: the model's
    bias_m: float = 0.0
    clock_drift_ppm: float = 40.0
    firmware: str = Field(default=Lms100Setup().firmware, min_length=1, max_length=9)
    refuses: Literal["", "mLMPsetscancfg", "LMPoutputRange", "LMDscandatacfg"] = ""  # a setting


def build(name: str, options: Lms100Options, ride: Ride, seed: int) -> TcpWire:
    mounting = SE2(options.x_m, options.y_m, math.radians(options.yaw_deg))
    optics = replace(OPTICS[options.model], bias_m=options.bias_m)
    if options.sigma_m is not None:
        optics = replace(optics, sigma_m=options.sigma_m)
    source = LaserTruth(ride, name, mounting, optics, seed)
    setup = Lms100Setup(
        options.model,
        options.ident,
        clock_drift_ppm=options.clock_drift_ppm,
        refused=frozenset(filter(None, (options.refuses,))),
        firmware=options.firmware,
    )
    return TcpWire(FakeLms100(source, setup, seed_of(seed, name)), options.host, options.port)


KIND = DeviceKind(Lms100Options, build)
