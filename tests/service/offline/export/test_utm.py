"""Against published values."""

import numpy as np
import pytest

from service.geometry.geo_reference import A_M
from service.offline.export.utm import to_utm, utm_zone

# GeographicLib, manual of GeoConvert(1), example with 5 decimals, 1 m
GEO_CONVERT = (33.33424, 44.40363), (38, 444500.0, 3688500.0)


def test_utm_is_the_published_one():
    (latitude_deg, longitude_deg), (zone, east_m, north_m) = GEO_CONVERT
    assert utm_zone(longitude_deg) == zone
    np.testing.assert_allclose(to_utm(latitude_deg, longitude_deg, zone, False), (east_m, north_m), atol=0.6)


def test_utm_of_the_south_counts_from_ten_thousand_kilometres_and_is_a_mirror_of_the_north():
    east_m, north_m = to_utm(48.1, 11.6, 32, False)
    assert to_utm(-48.1, 11.6, 32, True) == pytest.approx((east_m, 10_000_000.0 - north_m), abs=1e-6)
    west_m, _ = to_utm(48.1, 18.0 - 11.6, 32, False)  # as far on the other side of the meridian of 9 degrees
    assert west_m + east_m == pytest.approx(1_000_000.0, abs=1e-6)


def test_utm_along_its_meridian_is_the_length_of_the_meridian():
    """From the equator to a pole a meridian is 10 001 965.729 m long (Karney 2011, section 5)."""
    _, north_m = to_utm(84.0, 9.0, 32, False)
    steps_deg = np.linspace(0.0, 84.0, 200_001)
    middle = np.radians((steps_deg[1:] + steps_deg[:-1]) / 2.0)
    e2 = 1.0 - (1.0 - 1.0 / 298.257223563) ** 2
    radius_m = A_M * (1.0 - e2) / (1.0 - e2 * np.sin(middle) ** 2) ** 1.5
    length_m = float((radius_m * np.radians(np.diff(steps_deg))).sum())
    assert north_m == pytest.approx(0.9996 * length_m, abs=1e-3)


def test_utm_is_refused_near_a_pole():
    with pytest.raises(ValueError, match=r"UTM ends at 84 degrees of latitude; this is 85\.0"):
        to_utm(85.0, 0.0, 31, False)
