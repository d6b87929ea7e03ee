"""Position of a map on the earth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from service.geometry.geodesy import LocalFrame
from service.geometry.se2 import SE2

DATUM = "WGS 84"
KEYS = (
    "latitude_deg",
    "longitude_deg",
    "height_m",
    "east_m",
    "north_m",
    "yaw_deg",
    "position_sigma_m",
    "yaw_sigma_deg",
)


@dataclass(frozen=True, slots=True)
class GeoReference:
    """A map's frame against east and north about an origin.

    origin             where east and north are counted from: a fix of the drive
    pose_enu_map       takes m of the map to m east and north; its angle is the map's x axis against east,
                       counter-clockwise
    position_sigma_m   of the map's origin, each axis. What a receiver is constantly off by is not in it
    yaw_sigma_rad
    fixes              that anchor the map
    """

    origin: LocalFrame
    pose_enu_map: SE2
    position_sigma_m: float
    yaw_sigma_rad: float
    fixes: int

    def to_geodetic(self, x_m: float, y_m: float) -> tuple[float, float]:
        """latitude_deg, longitude_deg of a point of the map, at the origin's height."""
        enu = self.pose_enu_map @ SE2(x_m, y_m)
        return self.origin.on_ground(enu.x_m, enu.y_m)

    def heading_deg(self, theta_rad: float) -> float:
        """Clockwise from north, 0 to 360, of a direction in the map."""
        return (90.0 - math.degrees(theta_rad + self.pose_enu_map.theta_rad)) % 360.0

    def as_dict(self) -> dict[str, Any]:
        """For JSON; from_dict reads it."""
        pose = self.pose_enu_map
        return {
            "datum": DATUM,
            "latitude_deg": self.origin.latitude_deg,
            "longitude_deg": self.origin.longitude_deg,
            "height_m": self.origin.height_m,
            "east_m": pose.x_m,
            "north_m": pose.y_m,
            "yaw_deg": math.degrees(pose.theta_rad),
            "position_sigma_m": self.position_sigma_m,
            "yaw_sigma_deg": math.degrees(self.yaw_sigma_rad),
            "fixes": self.fixes,
        }

    @staticmethod
    def from_dict(about: Mapping[str, Any]) -> "GeoReference":
        """Raises ValueError, in words, for what as_dict cannot have made."""
        if not isinstance(about, Mapping) or about.get("datum") != DATUM:
            raise ValueError(f'no geo-reference: expected an object whose "datum" is "{DATUM}"')
        values: dict[str, float] = {}
        for key in KEYS:
            value = about.get(key)
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f'no geo-reference: "{key}" is {value!r}, expected a number')
            values[key] = float(value)
        fixes = about.get("fixes")
        if isinstance(fixes, bool) or not isinstance(fixes, int):
            raise ValueError(f'no geo-reference: "fixes" is {fixes!r}, expected a whole number')
        if abs(values["latitude_deg"]) > 90.0:
            raise ValueError(f'no geo-reference: "latitude_deg" is {values["latitude_deg"]}, beyond a pole')
        return GeoReference(
            LocalFrame(values["latitude_deg"], values["longitude_deg"], values["height_m"]),
            SE2(values["east_m"], values["north_m"], math.radians(values["yaw_deg"])),
            values["position_sigma_m"],
            math.radians(values["yaw_sigma_deg"]),
            fixes,
        )
