"""The fake SICK scanner as a type of device: its options and its wire."""

from typing import Literal

from pydantic import Field

from drivers.sick_lms100.models import ModelName
from simulators.device_kind import DeviceKind, LaserOptions
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from simulators.truth import LMS100, LMS500, TIM500, Ride, seed_of
from simulators.wire import TcpWire

OPTICS = {"lms1xx": LMS100, "lms5xx": LMS500, "tim5xx": TIM500, "tim7xx": TIM500}


class Lms100Options(LaserOptions):
    """Options of `sick_lms100:`."""

    model: ModelName = "lms1xx"
    ident: str = Field(default="", max_length=32)  # what it calls itself; "": as its model does
    firmware: str = Field(default=Lms100Setup().firmware, min_length=1, max_length=9)
    refuses: Literal["", "mLMPsetscancfg", "LMPoutputRange", "LMDscandatacfg"] = ""  # a setting


def build(name: str, options: Lms100Options, ride: Ride, seed: int) -> TcpWire:
    source = options.source(ride, name, OPTICS[options.model], seed)
    setup = Lms100Setup(
        options.model,
        options.ident,
        clock_drift_ppm=options.clock_drift_ppm,
        refused=frozenset(filter(None, (options.refuses,))),
        firmware=options.firmware,
    )
    return TcpWire(FakeLms100(source, setup, seed_of(seed, name)), options.host, options.port)


KIND = DeviceKind(Lms100Options, build)
