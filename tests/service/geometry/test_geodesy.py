"""Against published values, and against itself there and back."""

import numpy as np
import pytest

from service.geometry.geo_reference import LocalFrame, from_ecef, to_ecef

# GeographicLib, manual of CartConvert(1), examples
CART_CONVERT = (33.3, 44.4, 6000.0), (3816209.60, 3737108.55, 3485109.57)
CART_CONVERT_LOCAL = (33.0, 44.0, 20.0), (37288.97, 33374.29, 5783.65)
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
