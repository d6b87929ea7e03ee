"""WGS 84 to UTM, for programs that want a grid.

Source: Karney, Transverse Mercator with an accuracy of a few nanometers, 2011, eq. 7 to 12 and 35 (Krueger's
series to the sixth order).
"""

import math

from service.geometry.geo_reference import A_M, E2, F

UTM_SCALE = 0.9996
UTM_EAST_M = 500_000.0  # of the central meridian
UTM_SOUTH_M = 10_000_000.0  # added in the grid of the south
UTM_MAX_LATITUDE_DEG = 84.0

_N = F / (2.0 - F)  # third flattening
# Karney 2011, eq. 12, 14 and 35.
_RECTIFYING_M = A_M / (1.0 + _N) * (1.0 + _N**2 / 4.0 + _N**4 / 64.0 + _N**6 / 256.0)
_ALPHA = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180 - 127 * _N**5 / 288 + 7891 * _N**6 / 37800,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440 + 281 * _N**5 / 630 - 1983433 * _N**6 / 1935360,
    61 * _N**3 / 240 - 103 * _N**4 / 140 + 15061 * _N**5 / 26880 + 167603 * _N**6 / 181440,
    49561 * _N**4 / 161280 - 179 * _N**5 / 168 + 6601661 * _N**6 / 7257600,
    34729 * _N**5 / 80640 - 3418889 * _N**6 / 1995840,
    212378941 * _N**6 / 319334400,
)


def utm_zone(longitude_deg: float) -> int:
    """1 to 60, by longitude alone: without the exceptions of Norway and Svalbard."""
    return int((longitude_deg + 180.0) % 360.0 // 6.0) + 1


def to_utm(latitude_deg: float, longitude_deg: float, zone: int, is_south: bool) -> tuple[float, float]:
    """Easting and northing, m. zone may be a neighbour's, and the point may be across the equator.

    is_south   in the grid of the south, whose northings count from 10 000 km

    Raises ValueError beyond 84 degrees of latitude, where UTM ends.
    """
    if not abs(latitude_deg) <= UTM_MAX_LATITUDE_DEG:
        raise ValueError(
            f"UTM ends at {UTM_MAX_LATITUDE_DEG:g} degrees of latitude; this is {latitude_deg:.6f}"
        )
    latitude = math.radians(latitude_deg)
    longitude = math.radians((longitude_deg - (6.0 * zone - 183.0) + 180.0) % 360.0 - 180.0)
    e = math.sqrt(E2)
    tau = math.tan(latitude)
    sigma = math.sinh(e * math.atanh(e * tau / math.hypot(1.0, tau)))  # eq. 8
    tau_c = tau * math.hypot(1.0, sigma) - sigma * math.hypot(1.0, tau)  # eq. 7, of the conformal latitude
    xi_c = math.atan2(tau_c, math.cos(longitude))  # eq. 10
    eta_c = math.asinh(math.sin(longitude) / math.hypot(tau_c, math.cos(longitude)))
    xi, eta = xi_c, eta_c
    for j, alpha in enumerate(_ALPHA, start=1):  # eq. 11
        xi += alpha * math.sin(2 * j * xi_c) * math.cosh(2 * j * eta_c)
        eta += alpha * math.cos(2 * j * xi_c) * math.sinh(2 * j * eta_c)
    north_m = UTM_SCALE * _RECTIFYING_M * xi
    return UTM_EAST_M + UTM_SCALE * _RECTIFYING_M * eta, north_m + (UTM_SOUTH_M if is_south else 0.0)
