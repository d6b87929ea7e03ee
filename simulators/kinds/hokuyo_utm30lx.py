"""The fake Hokuyo laser as a type of device: its options and its wire."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.hokuyo_utm30lx.models import ModelName
from simulators.device_kind import DeviceKind, LaserOptions
from simulators.hokuyo_setup import REPLIES, Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.truth import URG04LX, UST, UTM30LX, Ride
from simulators.wire import PtyWire, TcpWire

OPTICS = {"utm_30lx": UTM30LX, "ust": UST, "urg_04lx_ug01": URG04LX}


class Utm30lxOptions(LaserOptions):
    """Options of `hokuyo_utm30lx:`."""

    model: ModelName = "utm_30lx"
    product: str = Field(default="", max_length=64)  # what it calls itself; "": as its model does
    wire: Literal["usb", "ethernet"] | None = None  # a terminal, or a TCP port; None: the first its model has
    link: Path | None = None  # usb: a symbolic link to the terminal, a name that stays
    motor_speed: float = Field(default=1.0, ge=0.9, le=1.1)  # of the nominal
    refuses: Literal["", "ME", "ND", "NE", "cluster", "skip"] = ""  # a command, or a part of all

    @model_validator(mode="after")
    def _model_has_the_wire(self) -> Self:
        if self.wire is not None and (self.model, self.wire) not in REPLIES:
            raise ValueError(f"model {self.model} has no wire {self.wire}")
        return self


def build(name: str, options: Utm30lxOptions, ride: Ride, seed: int) -> TcpWire | PtyWire:
    source = options.source(ride, name, OPTICS[options.model], seed)
    wire = options.wire or ("usb" if (options.model, "usb") in REPLIES else "ethernet")
    setup = Utm30lxSetup(
        wire,
        options.model,
        options.product,
        clock_drift_ppm=options.clock_drift_ppm,
        motor_speed=options.motor_speed,
        refused=frozenset(filter(None, (options.refuses,))),
    )
    device = FakeUtm30lx(source, setup)
    if wire == "usb":
        return PtyWire(device, options.link)
    return TcpWire(device, options.host, options.port)


KIND = DeviceKind(Utm30lxOptions, build)
