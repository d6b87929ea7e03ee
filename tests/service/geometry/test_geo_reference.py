import json
import math

import numpy as np
import pytest

from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2

ORIGIN = LocalFrame(60.161, 24.546, 51.7)
NORTHWARD = GeoReference(ORIGIN, SE2(3.0, -4.0, math.radians(90.0)), 0.8, math.radians(0.3), 41)


def test_a_map_that_looks_north_puts_its_x_axis_north():
    latitude_deg, longitude_deg = NORTHWARD.to_geodetic(100.0, 10.0)
    east_m, north_m, _ = ORIGIN.to_enu(latitude_deg, longitude_deg, 51.7)
    np.testing.assert_allclose((east_m, north_m), (3.0 - 10.0, -4.0 + 100.0), atol=1e-4)
    assert NORTHWARD.heading_deg(0.0) == pytest.approx(0.0, abs=1e-9)
    assert NORTHWARD.heading_deg(math.radians(30.0)) == pytest.approx(330.0)


def test_a_reference_survives_json():
    back = GeoReference.from_dict(json.loads(json.dumps(NORTHWARD.as_dict())))
    assert back.origin == ORIGIN
    assert back.fixes == 41
    assert back.yaw_sigma_rad == pytest.approx(NORTHWARD.yaw_sigma_rad)
    assert back.pose_enu_map.theta_rad == pytest.approx(NORTHWARD.pose_enu_map.theta_rad)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"datum": "NAD 27"}, '"datum" is "WGS 84"'),
        ({"yaw_deg": math.nan}, '"yaw_deg" is nan, expected a number'),
        ({"east_m": "3"}, "\"east_m\" is '3', expected a number"),
        ({"latitude_deg": 91.0}, "beyond a pole"),
        ({"fixes": 1.5}, '"fixes" is 1.5, expected a whole number'),
    ],
)
def test_what_is_no_reference_is_refused_in_words(change, words):
    with pytest.raises(ValueError, match=words):
        GeoReference.from_dict(NORTHWARD.as_dict() | change)
