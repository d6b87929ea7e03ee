"""Pose of a sensor on the vehicle."""

from pydantic import BaseModel, ConfigDict, Field


class Mounting(BaseModel):
    """Pose of the sensor in the base frame: x forward, y left, z up, yaw counter-clockwise seen from above.

    Upside down means turned by 180 deg about its own forward axis, before the yaw.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    x_m: float = Field(default=0.0, ge=-50.0, le=50.0)
    y_m: float = Field(default=0.0, ge=-50.0, le=50.0)
    z_m: float = Field(default=0.0, ge=-50.0, le=50.0)  # for /tf_static alone: the map is flat
    yaw_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    upside_down: bool = False
