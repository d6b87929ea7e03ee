"""The pretended LUX as a type of device: its options, and how it comes to its wire."""

import math
from dataclasses import replace
from typing import Literal

from pydantic import Field

from drivers.ibeo_lux.messages import Parameter
from drivers.mounting import OffsetM, TurnDeg
from service.geometry.se2 import SE2
from simulators.device_kind import DeviceKind, DeviceOptions
from simulators.ibeo_lux import FakeIbeoLux, LuxSetup
from simulators.truth import IBEO_LUX, LaserTruth, Ride, seed_of
from simulators.wire import TcpWire


class LuxOptions(DeviceOptions):
    """What may stand behind `ibeo_lux:`."""

    host: str = "127.0.0.1"
    port: int = Field(default=0, ge=0, le=65535)  # 0: any free
    x_m: OffsetM = 0.25  # mounting in the base frame
    y_m: OffsetM = 0.0
    yaw_deg: TurnDeg = 0.0
    sigma_m: float = Field(default=IBEO_LUX.sigma_m, ge=0.0)
    bias_m: float = IBEO_LUX.bias_m
    clock_drift_ppm: float = 40.0
    height_m: float | None = Field(default=None, gt=0.0)  # above ground, which the low layers then meet
    rain_share: float = Field(default=0.0, ge=0.0, le=1.0)  # of the shots that meet a drop first
    refuses: Literal["", "SCAN_FREQUENCY", "START_ANGLE", "END_ANGLE", "RESOLUTION"] = ""  # a parameter


def build(name: str, options: LuxOptions, ride: Ride, seed: int) -> TcpWire:
    mounting = SE2(options.x_m, options.y_m, math.radians(options.yaw_deg))
    model = replace(IBEO_LUX, sigma_m=options.sigma_m, bias_m=options.bias_m)
    source = LaserTruth(ride, name, mounting, model, seed)
    setup = LuxSetup(
        clock_drift_ppm=options.clock_drift_ppm,
        height_m=options.height_m,
        rain_share=options.rain_share,
        fixed=frozenset({Parameter[options.refuses]} if options.refuses else ()),
    )
    return TcpWire(FakeIbeoLux(source, setup, seed_of(seed, name)), options.host, options.port)


KIND = DeviceKind(LuxOptions, build)
