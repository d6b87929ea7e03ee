"""How messages of other laser devices become scans."""

from typing import Literal

from pydantic import Field, model_validator

from drivers.section import Section

Echo = Literal["strongest", "first", "last"]


class ConversionConfig(Section):
    """Of a sensor_msgs/MultiEchoLaserScan and of a sensor_msgs/PointCloud2.

    echo          which of a beam's echoes counts; the strongest, where no intensities come, is the first
    z_min_m       heights of a 3-D laser's points that count, in the base frame; where it is unknown at which
    z_max_m       height it sits, above and below the laser itself. None: see point_cloud
    min_range_m   nearer points of a 3-D laser are the vehicle's own
    """

    echo: Echo = "strongest"
    z_min_m: float | None = Field(default=None, ge=-100.0, le=100.0)
    z_max_m: float | None = Field(default=None, ge=-100.0, le=100.0)
    min_range_m: float = Field(default=0.3, ge=0.0, le=10.0)

    @model_validator(mode="after")
    def _is_a_band(self) -> "ConversionConfig":
        if self.z_min_m is not None and self.z_max_m is not None and self.z_min_m >= self.z_max_m:
            raise ValueError(f"z_min_m ({self.z_min_m:g}) is not below z_max_m ({self.z_max_m:g})")
        return self
