"""What the sections of all sensors have, and those of all lasers."""

from typing import Self

from pydantic import Field, model_validator

from drivers.mounting import Mounting
from drivers.section import Section

# A scan is mapped that began 300 ms before the newest pose at most: the latency and a sweep of 80 ms.
MIN_LATENCY_MS, MAX_LATENCY_MS = -50.0, 200.0


class SensorSection(Section):
    name: str = Field(min_length=1)
    # From calibration; positive makes stamps earlier.
    latency_ms: float = Field(default=0.0, ge=MIN_LATENCY_MS, le=MAX_LATENCY_MS)


class LaserSection(SensorSection):
    """The limits of the ranges have defaults and bounds of each type."""

    range_min_m: float
    range_max_m: float
    silence_timeout_s: float = Field(default=2.0, ge=0.5, le=60.0)  # without a scan the link is made again
    map: bool = True  # False: its scans are published and recorded, not mapped
    mounting: Mounting = Mounting()

    @model_validator(mode="after")
    def _ranges_are_in_order(self) -> Self:
        if self.range_min_m >= self.range_max_m:
            raise ValueError(
                f"{self.name}: range_min_m {self.range_min_m} must be below range_max_m {self.range_max_m}"
            )
        return self
