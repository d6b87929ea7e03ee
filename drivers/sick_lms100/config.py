"""Settings of one LMS1xx, LMS5xx, TiM5xx or TiM7xx, in config/*.yaml."""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from drivers.section import with_defaults_of_model
from drivers.sensor_section import LaserSection
from drivers.sick_lms100.models import MODELS, Model, ModelName
from drivers.wires import Host


class Lms100Config(LaserSection):
    """Settings of the device. The driver writes what differs, but not to its flash.

    The defaults that depend on the model are shown for an LMS1xx; see Model.defaults.
    """

    type: Literal["sick_lms100"] = "sick_lms100"
    model: ModelName = "lms1xx"
    host: Host = Field(min_length=1)
    port: int = Field(default=2111, ge=1, le=65535)  # or 2112
    dialect: Literal["auto", "cola_a", "cola_b"] = "auto"  # auto tries both; the device is never rewritten
    password_hash: str = Field(default="F4724744", pattern=r"^[0-9A-Fa-f]{8}$")  # of level 3, "client"
    scan_rate_hz: Literal[15, 25, 35, 50, 75, 100] = 50
    angle_step_deg: float = 0.5
    first_angle_deg: float = Field(default=-135.0, ge=-135.0, le=135.0)  # sensor frame, 0 straight ahead
    last_angle_deg: float = Field(default=135.0, ge=-135.0, le=135.0)
    echo: Literal["first", "last"] = "first"  # last sees through rain, dust and wire mesh where there are two
    intensity_bits: Literal[0, 8, 16] = 0  # 0: no intensity
    range_min_m: float = Field(default=0.05, ge=0.0, le=5.0)
    range_max_m: float = Field(default=20.0, gt=0.0, le=131.0)

    @model_validator(mode="before")
    @classmethod
    def _with_defaults_of_model(cls, given: Any) -> Any:
        return with_defaults_of_model(given, MODELS)

    @model_validator(mode="after")
    def _device_can_do_it(self) -> Self:
        can = self.limits
        for key, value, possible in (
            ("scan_rate_hz", self.scan_rate_hz, can.rates_hz),
            ("angle_step_deg", self.angle_step_deg, can.steps_deg),
        ):
            if value not in possible:
                either = " or ".join(f"{one:g}" for one in sorted(possible))
                raise ValueError(f"{self.name}: {key} of model {self.model} must be {either}, not {value:g}")
        most_hz = max(rate for rate in can.rates_hz if can.has_time_for(rate, self.angle_step_deg))
        if self.scan_rate_hz > most_hz:
            raise ValueError(
                f"{self.name}: angle_step_deg {self.angle_step_deg:g} needs scan_rate_hz {most_hz} or less, "
                f"not {self.scan_rate_hz}"
            )
        if self.echo != "first" and can.echoes == "one":
            raise ValueError(f"{self.name}: model {self.model} has no echo {self.echo}; write echo: first")
        least_deg, most_deg = can.field_of_view_deg
        if self.first_angle_deg < least_deg or self.last_angle_deg > most_deg:
            raise ValueError(
                f"{self.name}: first_angle_deg {self.first_angle_deg:g} to last_angle_deg "
                f"{self.last_angle_deg:g} must lie within {least_deg:g} to {most_deg:g}, which model "
                f"{self.model} sees"
            )
        if self.first_angle_deg + self.angle_step_deg > self.last_angle_deg:
            raise ValueError(
                f"{self.name}: first_angle_deg {self.first_angle_deg} must lie below "
                f"last_angle_deg {self.last_angle_deg} by a step or more"
            )
        return self

    @property
    def limits(self) -> Model:
        """Limits of this model."""
        return MODELS[self.model]
