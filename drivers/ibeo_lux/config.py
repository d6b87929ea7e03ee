"""Settings of one IBEO LUX, LUX HD, LUX 8L or SICK LD-MRS, in config/*.yaml."""

from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.ibeo_lux.messages import TICKS_PER_DEG
from drivers.sensor_section import LaserSection
from drivers.wires import Host

Label = Literal["dirt", "rain", "ground", "transparent"]


class IbeoLuxConfig(LaserSection):
    """Settings of the device and of the reduction to one scan. The device's flash is never written."""

    type: Literal["ibeo_lux"] = "ibeo_lux"
    host: Host = Field(min_length=1)
    port: int = Field(default=12_002, ge=1, le=65_535)
    scan_rate_hz: float = 25.0
    # Sensor frame; the sweep goes to the right.
    first_angle_deg: float = Field(default=50.0, ge=-59.95, le=50.0)
    last_angle_deg: float = Field(default=-60.0, ge=-60.0, le=49.95)
    resolution: Literal["as_set", "focused", "constant"] = "as_set"
    sync_angle_deg: float | None = Field(default=None, ge=-180.0, lt=180.0)  # None: left as it is
    upside_down: bool | None = None  # None: left as it is
    set_clock: bool = True  # to UTC, at each connection
    layers: tuple[Literal[0, 1, 2, 3], ...] = Field(default=(0, 1, 2, 3), min_length=1)  # 0 is the lowest
    layer_choice: Literal["horizon", "nearest", "median"] = "horizon"
    echo: Literal["first", "last", "strongest"] = "last"  # last sees through rain, dust and glass
    discard: tuple[Label, ...] = ("dirt", "rain", "ground", "transparent")  # where the device labelled it
    mirror_sides: Literal["both", "front", "rear"] = "both"  # of eight-layer units: front looks down, rear up
    angle_step_deg: float = 0.125
    pitch_deg: float = Field(default=0.0, ge=-20.0, le=20.0)  # of the mounting; positive looks down
    roll_deg: float = Field(default=0.0, ge=-20.0, le=20.0)  # of the mounting; positive leans to the right
    height_m: float | None = Field(default=None, gt=0.0, le=10.0)  # above ground; None: ground is not cut
    ground_below_m: float = Field(default=0.10, ge=0.0, le=2.0)  # above ground; lower points are ground
    intensity: bool = False  # echo pulse widths, cm
    range_min_m: float = Field(default=0.3, ge=0.0, le=5.0)
    range_max_m: float = Field(default=200.0, gt=0.0, le=300.0)

    @property
    def first_ticks(self) -> int:
        """Even: with odd start or end angles some firmware sends no scans at all."""
        return 2 * round(self.first_angle_deg * TICKS_PER_DEG / 2)

    @property
    def last_ticks(self) -> int:
        return 2 * round(self.last_angle_deg * TICKS_PER_DEG / 2)

    @model_validator(mode="after")
    def _device_can_do_it(self) -> Self:
        if self.scan_rate_hz not in (12.5, 25.0, 50.0):
            raise ValueError(f"{self.name}: scan_rate_hz must be 12.5, 25 or 50, not {self.scan_rate_hz:g}")
        if self.angle_step_deg not in (0.125, 0.25, 0.5):
            raise ValueError(
                f"{self.name}: angle_step_deg must be 0.125, 0.25 or 0.5, not {self.angle_step_deg:g}"
            )
        if self.first_ticks <= self.last_ticks:
            raise ValueError(
                f"{self.name}: first_angle_deg {self.first_angle_deg} must lie above "
                f"last_angle_deg {self.last_angle_deg}: the mirror sweeps from left to right"
            )
        if len(set(self.layers)) != len(self.layers):
            raise ValueError(f"{self.name}: layers names one twice: {list(self.layers)}")
        return self
