"""The fake LUX as a type of device: its options and its wire."""

from typing import Literal

from pydantic import Field

from drivers.ibeo_lux.messages import Parameter
from drivers.mounting import OffsetM
from simulators.device_kind import DeviceKind, LaserOptions
from simulators.ibeo_lux import FakeIbeoLux, LuxSetup
from simulators.truth import IBEO_LUX, Ride, seed_of
from simulators.wire import TcpWire


class LuxOptions(LaserOptions):
    """Options of `ibeo_lux:`."""

    x_m: OffsetM = 0.25
    height_m: float | None = Field(default=None, gt=0.0)  # above ground, which the low layers then meet
    rain_share: float = Field(default=0.0, ge=0.0, le=1.0)  # of the shots that meet a drop first
    refuses: Literal["", "SCAN_FREQUENCY", "START_ANGLE", "END_ANGLE", "RESOLUTION"] = ""  # a parameter


def build(name: str, options: LuxOptions, ride: Ride, seed: int) -> TcpWire:
    source = options.source(ride, name, IBEO_LUX, seed)
    setup = LuxSetup(
        clock_drift_ppm=options.clock_drift_ppm,
        height_m=options.height_m,
        rain_share=options.rain_share,
        fixed=frozenset({Parameter[options.refuses]} if options.refuses else ()),
    )
    return TcpWire(FakeIbeoLux(source, setup, seed_of(seed, name)), options.host, options.port)


KIND = DeviceKind(LuxOptions, build)
