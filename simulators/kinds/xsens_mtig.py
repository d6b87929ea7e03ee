"""The fake MTi-G as a type of device: its options and its wire."""

import math
from pathlib import Path

from pydantic import Field, field_validator

from drivers.xsens_mtig.protocol import CODE_OF_BAUD
from simulators.device_kind import DeviceKind, MountedOptions
from simulators.inertial import Datum, ImuMounting, InertialTruth
from simulators.truth import Ride
from simulators.wire import PtyWire
from simulators.xsens_mtig import FakeMtiG, MtigSetup, Personality


class MtigOptions(MountedOptions):
    """Options of `xsens_mtig:`."""

    personality: Personality = "mtdata2"  # MTi-G-710; legacy: MTi-G
    link: Path | None = None  # a symbolic link to the terminal, a name that stays
    baud: int = 115_200  # stored in the unit; the pace of its line
    product: str = Field(
        default="", pattern="^(MTi[A-Za-z0-9-]*)?$", max_length=20
    )  # MTi-30-2A5G4: no receiver
    satellites: bool = True
    gnss_sigma_m: float = Field(default=1.5, ge=0.0)
    latitude_deg: float = Field(default=Datum().latitude_deg, ge=-85.0, le=85.0)  # of the world's origin
    longitude_deg: float = Field(default=Datum().longitude_deg, ge=-180.0, le=180.0)
    height_m: float = Datum().height_m
    heading_deg: float = 0.0  # of the world's x axis, counter-clockwise from east

    @field_validator("baud")
    @classmethod
    def _possible(cls, baud: int) -> int:
        if baud not in CODE_OF_BAUD:
            raise ValueError(f"{baud} is none of {sorted(CODE_OF_BAUD)}")
        return baud


def build(name: str, options: MtigOptions, ride: Ride, seed: int) -> PtyWire:
    source = InertialTruth(
        ride,
        name,
        ImuMounting(options.x_m, options.y_m, options.yaw_rad),
        seed=seed,
        datum=Datum(
            options.latitude_deg, options.longitude_deg, options.height_m, math.radians(options.heading_deg)
        ),
        gnss_sigma_m=options.gnss_sigma_m if options.satellites else None,
    )
    setup = MtigSetup(options.personality, options.baud, options.clock_drift_ppm, product=options.product)
    return PtyWire(FakeMtiG(source, setup), options.link)


KIND = DeviceKind(MtigOptions, build)
