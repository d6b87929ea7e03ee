"""Position of a map on the earth, and WGS 84 <-> metres: earth-centred, and east/north/up about an origin.

East and north are measured in the plane that touches the ellipsoid at the origin. A point on the ground that
is d away is shown d^3 / (6 R^2) too near: 0.5 mm at 5 km, 4 mm at 10 km, 0.5 m at 50 km. One that is h higher
than the origin is shown d * h / R too far: 8 cm for 100 m of height at 5 km.

Source: EPSG Guidance Note 7-2, 4.1.1 and 4.1.2 (geocentric, topocentric); Bowring, The accuracy of geodetic
latitude and height equations, 1985.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from service.geometry.poses import Floats
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
A_M = 6_378_137.0  # WGS 84: half the major axis
F = 1.0 / 298.257223563  # flattening
E2 = F * (2.0 - F)  # square of the first eccentricity
B_M = A_M * (1.0 - F)


def to_ecef(latitude_deg: float, longitude_deg: float, height_m: float) -> Floats:
    """(3,) m, earth-centred: x to 0 N 0 E, z to the north pole. height_m is above the ellipsoid."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    s, c = math.sin(latitude), math.cos(latitude)
    normal_m = A_M / math.sqrt(1.0 - E2 * s * s)
    out_m = (normal_m + height_m) * c
    return np.array(
        [out_m * math.cos(longitude), out_m * math.sin(longitude), (normal_m * (1.0 - E2) + height_m) * s]
    )


def from_ecef(xyz_m: Floats) -> tuple[float, float, float]:
    """latitude_deg, longitude_deg, height_m of a point (3,), m. Good to a micrometre within 1000 km of the
    ellipsoid.
    """
    x, y, z = map(float, xyz_m)
    out_m = math.hypot(x, y)
    beta = math.atan2(z * A_M, out_m * B_M)
    latitude = 0.0
    for _ in range(3):  # Bowring's first is good to a tenth of a millimetre on the ground
        latitude = math.atan2(
            z + E2 / (1.0 - E2) * B_M * math.sin(beta) ** 3, out_m - E2 * A_M * math.cos(beta) ** 3
        )
        beta = math.atan2((1.0 - F) * math.sin(latitude), math.cos(latitude))
    s, c = math.sin(latitude), math.cos(latitude)
    height_m = out_m * c + z * s - A_M * math.sqrt(1.0 - E2 * s * s)
    return math.degrees(latitude), math.degrees(math.atan2(y, x)), height_m


@dataclass(frozen=True)
class LocalFrame:
    """East, north, up in metres about an origin on the earth."""

    latitude_deg: float
    longitude_deg: float
    height_m: float  # above the ellipsoid

    @cached_property
    def _origin(self) -> Floats:
        return to_ecef(self.latitude_deg, self.longitude_deg, self.height_m)

    @cached_property
    def _axes(self) -> Floats:
        """(3, 3) rows east, north, up in earth-centred axes."""
        latitude, longitude = math.radians(self.latitude_deg), math.radians(self.longitude_deg)
        s, c, sl, cl = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
        return np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])

    def to_enu(self, latitude_deg: float, longitude_deg: float, height_m: float) -> Floats:
        """(3,) m east, north, up of a point."""
        enu: Floats = self._axes @ (to_ecef(latitude_deg, longitude_deg, height_m) - self._origin)
        return enu

    def from_enu(self, enu_m: Floats) -> tuple[float, float, float]:
        """latitude_deg, longitude_deg, height_m of a point (3,), m."""
        return from_ecef(self._origin + self._axes.T @ enu_m)

    def on_ground(self, east_m: float, north_m: float) -> tuple[float, float]:
        """latitude_deg, longitude_deg of a point of the plane, at the origin's height.

        The ground falls away below the plane by d^2 / (2 R).
        """
        down_m = (east_m**2 + north_m**2) / (2.0 * A_M)
        latitude_deg, longitude_deg, _ = self.from_enu(np.array([east_m, north_m, -down_m]))
        return latitude_deg, longitude_deg


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
