"""Settings of one LMS100, LMS111 or other LMS1xx, as they stand in config/*.yaml."""

from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.latency import LatencyMs
from drivers.mounting import Mounting
from drivers.section import Section
from drivers.wires import Host


class Lms100Config(Section):
    """What the device shall do. Where it does something else, the driver changes it, but not its flash."""

    type: Literal["sick_lms100"] = "sick_lms100"
    name: str = Field(min_length=1)
    host: Host = Field(min_length=1)
    port: int = Field(default=2111, ge=1, le=65535)  # or 2112
    dialect: Literal["auto", "cola_a", "cola_b"] = "auto"  # auto asks in both; the device is never rewritten
    password_hash: str = Field(default="F4724744", pattern=r"^[0-9A-Fa-f]{8}$")  # of level 3, "client"
    scan_rate_hz: Literal[25, 50] = 50
    angle_step_deg: float = 0.5
    first_angle_deg: float = Field(default=-135.0, ge=-135.0, le=135.0)  # sensor frame, 0 straight ahead
    last_angle_deg: float = Field(default=135.0, ge=-135.0, le=135.0)
    echo: Literal["first", "last"] = "first"  # last sees through rain, dust and wire mesh where there are two
    intensity_bits: Literal[0, 8, 16] = 0  # 0: no intensity
    range_min_m: float = Field(default=0.05, ge=0.0, le=5.0)
    range_max_m: float = Field(default=20.0, gt=0.0, le=131.0)
    latency_ms: LatencyMs = 0.0  # from calibration
    silence_timeout_s: float = Field(default=2.0, ge=0.5, le=60.0)  # without a scan the link is made anew
    map: bool = True  # False: its scans are published and recorded, not mapped
    mounting: Mounting = Mounting()

    @model_validator(mode="after")
    def _device_can_do_it(self) -> Self:
        if self.angle_step_deg not in (0.25, 0.5):
            raise ValueError(f"{self.name}: angle_step_deg must be 0.25 or 0.5, not {self.angle_step_deg}")
        if self.scan_rate_hz == 50 and self.angle_step_deg == 0.25:
            raise ValueError(f"{self.name}: angle_step_deg 0.25 needs scan_rate_hz 25, not 50")
        if self.first_angle_deg + self.angle_step_deg > self.last_angle_deg:
            raise ValueError(
                f"{self.name}: first_angle_deg {self.first_angle_deg} must lie below "
                f"last_angle_deg {self.last_angle_deg} by a step or more"
            )
        if self.range_min_m >= self.range_max_m:
            raise ValueError(
                f"{self.name}: range_min_m {self.range_min_m} must be below range_max_m {self.range_max_m}"
            )
        return self
