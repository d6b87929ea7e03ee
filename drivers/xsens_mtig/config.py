"""Settings of an Xsens MTi-G, MTi-G-700 or MTi-G-710 as source of inertial samples and GNSS fixes."""

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.mounting import Mounting
from drivers.sensor_section import SensorSection
from drivers.wires import DeviceFile
from drivers.xsens_mtig.orientation import apply, axes_of
from drivers.xsens_mtig.protocol import CODE_OF_BAUD
from drivers.xsens_mtig.reals import Precision

Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
PRECISIONS = {
    "float32": Precision.FLOAT32,
    "fp12.20": Precision.FP1220,
    "fp16.32": Precision.FP1632,
    "float64": Precision.FLOAT64,
}
USB = "usb"
AUTO: Literal["auto"] = "auto"


class XsensMtigConfig(SensorSection):
    """Settings of the device. What differs is written to it and stored there."""

    type: Literal["xsens_mtig"] = "xsens_mtig"
    device: DeviceFile = Field(min_length=1)  # a path, a pyserial URL, "usb", or "usb:<serial number>"
    baud: int | Literal["auto"] = AUTO
    store_baud: int | None = None  # put this rate into the device where it has another rate
    configure: bool = True  # false: take what it sends; only time and rate of turn must be among it
    rate_hz: Literal[10, 20, 25, 40, 50, 80, 100, 200, 400] = 200
    orientation: bool | Literal["auto"] = AUTO  # auto: where the line carries it
    gnss: bool = True
    number_format: Literal["float32", "fp12.20", "fp16.32", "float64"] = "float32"
    filter_profile: str | None = None  # by the device's own name for it, e.g. automotive; None: as it is
    lever_arm_m: tuple[float, float, float] | None = None  # device axes, to the GNSS antenna; None: as it is
    forward_axis: Axis = "x"  # which axis of the housing looks ahead, and which up
    up_axis: Axis = "z"
    silence_timeout_s: float = Field(default=2.0, ge=0.5, le=60.0)  # without a sample the link is made again
    mounting: Mounting = Mounting()

    @model_validator(mode="after")
    def _can_be_done(self) -> Self:
        for key, baud in (("baud", self.baud), ("store_baud", self.store_baud)):
            if isinstance(baud, int) and baud not in CODE_OF_BAUD:
                raise ValueError(f"{key} {baud} is none of the device's rates {sorted(CODE_OF_BAUD)}")
        if self.store_baud is not None and self.baud not in (AUTO, self.store_baud):
            raise ValueError(
                f"store_baud {self.store_baud} would make the device unheard at baud {self.baud}; "
                "write baud: auto"
            )
        if self.over_usb and (self.baud != AUTO or self.store_baud is not None):
            raise ValueError(f"device {self.device} has no baud rate; leave baud and store_baud out")
        if self.lever_arm_m is not None and max(map(abs, self.lever_arm_m)) > 100.0:
            raise ValueError(f"lever_arm_m {self.lever_arm_m} is in metres; none is longer than 100")
        axes_of(self.forward_axis, self.up_axis)
        return self

    @property
    def antenna_m(self) -> tuple[float, float, float] | None:
        """Forward, left and up of the GNSS antenna in the base frame; None: the lever arm is not given."""
        if self.lever_arm_m is None:
            return None
        forward_m, left_m, up_m = apply(axes_of(self.forward_axis, self.up_axis), self.lever_arm_m)
        if self.mounting.upside_down:
            left_m, up_m = -left_m, -up_m
        yaw_rad = math.radians(self.mounting.yaw_deg)
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        return (
            self.mounting.x_m + c * forward_m - s * left_m,
            self.mounting.y_m + s * forward_m + c * left_m,
            self.mounting.z_m + up_m,
        )

    @property
    def over_usb(self) -> bool:
        """Through libusb, without a serial line."""
        return self.device == USB or self.device.startswith(f"{USB}:")

    @property
    def usb_serial(self) -> str | None:
        """Serial number of one of several units; None: the only one."""
        return self.device.removeprefix(f"{USB}:") if ":" in self.device else None

    @property
    def precision(self) -> Precision:
        return PRECISIONS[self.number_format]
