"""Against published values, and against itself there and back."""

import numpy as np
import pytest

from service.geometry.geodesy import A_M, LocalFrame, from_ecef, to_ecef, to_utm, utm_zone

# GeographicLib, manuals of CartConvert(1) and GeoConvert(1), examples; the last has 5 decimals, 1 m
CART_CONVERT = (33.3, 44.4, 6000.0), (3816209.60, 3737108.55, 3485109.57)
CART_CONVERT_LOCAL = (33.0, 44.0, 20.0), (37288.97, 33374.29, 5783.65)
GEO_CONVERT = (33.33424, 44.40363), (38, 444500.0, 3688500.0)
# Mathworks, documentation of geodetic2enu: the Matterhorn seen from Zermatt
ZERMATT, MATTERHORN = (46.017, 7.750, 1673.0), (45.976, 7.658, 4531.0)
MATTERHORN_ENU = (-7134.757, -4556.322, 2852.390)


def test_earth_centred_coordinates_are_the_published_ones():
    geodetic, ecef = CART_CONVERT
    np.testing.assert_allclose(to_ecef(*geodetic), ecef, atol=0.006)


@pytest.mark.parametrize(
    ("origin", "point", "enu", "tolerance_m"),
    [
        (CART_CONVERT_LOCAL[0], CART_CONVERT[0], CART_CONVERT_LOCAL[1], 0.006),
        (ZERMATT, MATTERHORN, MATTERHORN_ENU, 0.001),
    ],
)
def test_east_north_up_are_the_published_ones(origin, point, enu, tolerance_m):
    np.testing.assert_allclose(LocalFrame(*origin).to_enu(*point), enu, atol=tolerance_m)


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


@pytest.mark.parametrize("latitude_deg", [-89.9, -45.0, 0.0, 12.3, 60.16, 90.0])
@pytest.mark.parametrize("height_m", [-400.0, 0.0, 8848.0])
def test_geodetic_and_earth_centred_there_and_back(latitude_deg, height_m):
    back = from_ecef(to_ecef(latitude_deg, 179.99, height_m))
    assert back[0] == pytest.approx(latitude_deg, abs=1e-11)
    assert back[2] == pytest.approx(height_m, abs=1e-6)
    if latitude_deg < 90.0:
        assert back[1] == pytest.approx(179.99, abs=1e-11)


def test_a_point_of_the_plane_there_and_back_over_the_date_line():
    frame = LocalFrame(-17.0, 179.9999, 12.0)
    latitude_deg, longitude_deg = frame.on_ground(500.0, -300.0)
    assert longitude_deg < -179.99
    np.testing.assert_allclose(
        frame.to_enu(latitude_deg, longitude_deg, 12.0)[:2], (500.0, -300.0), atol=1e-4
    )
