"""The fake Create as a type of device: its options and its wire."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import Field

from drivers.irobot_create.config import PRESETS
from simulators.device_kind import DeviceKind, DeviceOptions
from simulators.irobot_create import FakeCreate
from simulators.truth import CREATE_WHEELS, Ride, WheelTruth
from simulators.wire import PtyWire


class CreateOptions(DeviceOptions):
    """Options of `irobot_create:`."""

    model: Literal["create1", "create2", "roomba"] = "create2"
    link: Path | None = None  # a symbolic link to the terminal, a name that stays
    scale_sigma: float = Field(default=CREATE_WHEELS.scale_sigma, ge=0.0)
    slip_sigma_m: float = Field(default=CREATE_WHEELS.slip_sigma_m, ge=0.0)
    slips_per_m: float = Field(default=CREATE_WHEELS.slips_per_m, ge=0.0)


def build(name: str, options: CreateOptions, ride: Ride, seed: int) -> PtyWire:
    model = replace(
        CREATE_WHEELS,
        wheel_base_m=PRESETS[options.model].wheel_base_m,
        scale_sigma=options.scale_sigma,
        slip_sigma_m=options.slip_sigma_m,
        slips_per_m=options.slips_per_m,
    )
    wheels = WheelTruth(ride, name, model, seed)
    return PtyWire(FakeCreate(wheels, options.model, wakes_on_connect=True), options.link)


KIND = DeviceKind(CreateOptions, build)
