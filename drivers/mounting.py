"""Pose of a sensor on the vehicle."""

from typing import Annotated

from pydantic import Field

from drivers.section import Section

MAX_OFFSET_M = 50.0  # on a vehicle
OffsetM = Annotated[float, Field(ge=-MAX_OFFSET_M, le=MAX_OFFSET_M)]
TurnDeg = Annotated[float, Field(ge=-360.0, le=360.0)]


class Mounting(Section):
    """Pose of the sensor in the base frame: x forward, y left, z up, yaw counter-clockwise seen from above.

    Upside down means turned by 180 deg about its own forward axis, before the yaw.
    """

    x_m: OffsetM = 0.0
    y_m: OffsetM = 0.0
    z_m: OffsetM = 0.0  # for /tf_static alone: the map is flat
    yaw_deg: TurnDeg = 0.0
    upside_down: bool = False
