"""Settings of one UTM-30LX, UST or URG-04LX-UG01, in config/*.yaml."""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from drivers.hokuyo_utm30lx.models import MODELS, Model, ModelName
from drivers.section import with_defaults_of_model
from drivers.sensor_section import LaserSection
from drivers.wires import DeviceFile, Host


class HokuyoUtm30lxConfig(LaserSection):
    """Settings of the device and its port: `device` for USB, `host` for Ethernet, never both.

    The defaults that depend on the model are shown for a UTM-30LX; see Model.defaults.
    """

    type: Literal["hokuyo_utm30lx"] = "hokuyo_utm30lx"
    model: ModelName = "utm_30lx"  # UTM-30LX and UTM-30LX-EW
    device: DeviceFile | None = Field(default=None, min_length=1)  # UTM-30LX: path, or a pyserial URL
    host: Host | None = Field(default=None, min_length=1)  # UTM-30LX-EW; 192.168.0.10 from the factory
    port: int = Field(default=10940, ge=1, le=65535)  # with host alone
    serial_number: str | None = Field(default=None, min_length=1)  # as VV reports; another unit is refused
    first_angle_deg: float = Field(default=-135.0, ge=-180.0, le=180.0)  # sensor frame, 0 straight ahead;
    last_angle_deg: float = Field(default=135.0, ge=-180.0, le=180.0)  # cut to what the device can see
    cluster: int = Field(default=1, ge=1, le=99)  # of so many neighbouring beams the nearest is taken
    skip_scans: int = Field(default=0, ge=0, le=9)  # left out after each one sent: 1 is 20 Hz
    intensity: bool = False
    echo: Literal["first", "last", "strongest"] = "first"  # others than first: Ethernet alone
    time_sync: bool = True  # query the device's clock at the start; takes half a second
    stamp_moment: Literal["first_step", "rear"] = "first_step"  # what the device stamps; see its page in docs
    range_min_m: float = Field(default=0.1, ge=0.0, le=5.0)
    range_max_m: float = Field(default=30.0, gt=0.0, le=262.0)

    @model_validator(mode="before")
    @classmethod
    def _with_defaults_of_model(cls, given: Any) -> Any:
        return with_defaults_of_model(given, MODELS)

    @model_validator(mode="after")
    def _one_wire_that_can_do_it(self) -> Self:
        if (self.device is None) == (self.host is None):
            raise ValueError(
                f"{self.name}: give either device (USB, such as /dev/ttyACM0) or host "
                "(Ethernet), and not both"
            )
        wire = "device" if self.host is None else "host"
        if wire not in self.limits.wires:
            raise ValueError(f"{self.name}: model {self.model} has no {wire}; give {self.limits.wires[0]}")
        if self.intensity and not self.limits.has_intensity:
            raise ValueError(f"{self.name}: model {self.model} sends no intensity: leave it out")
        if self.echo != "first" and not self.limits.has_echoes:
            raise ValueError(f"{self.name}: model {self.model} has no echo {self.echo}; write echo: first")
        if self.host is None and self.echo != "first":
            raise ValueError(f"{self.name}: echo {self.echo} needs a UTM-30LX-EW (host); USB has echo: first")
        if self.first_angle_deg >= self.last_angle_deg:
            raise ValueError(
                f"{self.name}: first_angle_deg {self.first_angle_deg} must lie below "
                f"last_angle_deg {self.last_angle_deg}"
            )
        return self

    @property
    def limits(self) -> Model:
        """Limits of this model."""
        return MODELS[self.model]

    @property
    def scan_command(self) -> str:
        """The stream that has the configured data. The strongest echo needs intensities."""
        stream = "M" if self.echo == "first" else "N"
        return stream + ("E" if self.intensity or self.echo == "strongest" else "D")
