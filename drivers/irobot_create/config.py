"""Settings of an iRobot Create or Roomba as source of odometry."""

import math
from typing import Literal, NamedTuple

from pydantic import Field, model_validator

from drivers.sensor_section import SensorSection
from drivers.wires import DeviceFile


class _Preset(NamedTuple):
    baud: int
    wheel_base_m: float
    wheel_diameter_m: float
    counts_per_revolution: float


# Create 2 Open Interface 2016, packet 43 (508.8 counts, 72 mm wheel, 235 mm base); Create Open Interface
# 2006. A Create 1 shows no encoders and reports integer millimetres and degrees instead.
PRESETS = {
    "create1": _Preset(57_600, 0.258, math.nan, math.nan),
    "create2": _Preset(115_200, 0.235, 0.072, 508.8),
    "roomba": _Preset(115_200, 0.235, 0.072, 508.8),
}

BAUDS = (300, 600, 1200, 2400, 4800, 9600, 14_400, 19_200, 28_800, 38_400, 57_600, 115_200)  # opcode 129
SLOWEST_BAUD = 28_800  # 37 bytes every 15 ms take 24 667 bit/s

RETRY_START_NS = 1_000_000_000
GIVE_UP_NS = 8_000_000_000  # longer than any banner, so that a robot that was reset is waited for


class IrobotCreateConfig(SensorSection):
    """One robot on one serial port.

    There is no mounting: the middle of the wheel axle *is* the base frame's origin, and the other sensors'
    mountings are measured from there.
    """

    type: Literal["irobot_create"] = "irobot_create"
    device: DeviceFile = Field(min_length=1)  # a path, or a pyserial URL such as socket://192.168.0.7:4000
    model: Literal["create1", "create2", "roomba"] = "create2"  # roomba: series 500 to 800
    baud: int = 0  # filled in by the model where not given
    wheel_base_m: float = Field(default=math.nan, gt=0.0, le=2.0)  # this and the next two: likewise
    wheel_diameter_m: float = Field(default=math.nan, gt=0.0, le=1.0)
    counts_per_revolution: float = Field(default=math.nan, gt=0.0, le=100_000.0)
    # True distance / reported distance, from a calibration drive.
    left_scale: float = Field(default=1.0, ge=0.5, le=2.0)
    right_scale: float = Field(default=1.0, ge=0.5, le=2.0)
    travel_variance_m2_per_m: float = Field(default=1e-4, gt=0.0, le=1.0)  # of each wheel, per metre rolled
    poll_interval_ms: int = Field(default=100, ge=50, le=500)  # create1 alone
    wake_line: bool = True  # pulse RTS and DTR, which many cables wire to the robot's BRC

    @model_validator(mode="before")
    @classmethod
    def _fill_from_the_model(cls, values: object) -> object:
        if not isinstance(values, dict):
            return values
        preset = PRESETS.get(str(values.get("model", "create2")))
        if preset is None:
            return values  # the field's own error names the models there are
        if preset is PRESETS["create1"]:
            for key in ("wheel_diameter_m", "counts_per_revolution"):
                if key in values:
                    raise ValueError(
                        f"{key} means nothing to a create1, which reports millimetres and degrees; "
                        "correct it by left_scale, right_scale and wheel_base_m"
                    )
        known = {key: value for key, value in preset._asdict().items() if not math.isnan(value)}
        return known | values

    @model_validator(mode="after")
    def _baud_carries_the_stream(self) -> "IrobotCreateConfig":
        if self.baud not in BAUDS:
            raise ValueError(f"baud {self.baud} is none of the robot's rates {BAUDS}")
        if self.model != "create1" and self.baud < SLOWEST_BAUD:
            raise ValueError(f"baud {self.baud} is too slow for a frame every 15 ms; take {SLOWEST_BAUD}")
        return self

    @property
    def left_m_per_count(self) -> float:
        return math.pi * self.wheel_diameter_m / self.counts_per_revolution * self.left_scale

    @property
    def right_m_per_count(self) -> float:
        return math.pi * self.wheel_diameter_m / self.counts_per_revolution * self.right_scale

    @property
    def firmware_wheel_base_m(self) -> float:
        """The wheel base by which a Create 1 itself turns wheel travel into degrees."""
        return PRESETS[self.model].wheel_base_m
