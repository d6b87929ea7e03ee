"""What PP says of the device: taken where it can be a laser, refused where not."""

import pytest

from drivers.errors import ProtocolError
from drivers.hokuyo_utm30lx.geometry import Geometry

REAL = {
    "MODL": "UTM-30LX(Hokuyo Automatic Co.,Ltd.)",
    **{"DMIN": "23", "DMAX": "60000", "ARES": "1440", "AMIN": "0", "AMAX": "1080", "AFRT": "540"},
    "SCAN": "2400",
}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("SCAN", "0"), ("SCAN", "59"), ("SCAN", "12001"), ("SCAN", "9" * 400)),
        *(("ARES", "3"), ("ARES", "100001"), ("ARES", "1" + "0" * 400), ("DMIN", "-1"), ("DMAX", "262144")),
        *(("ARES", ""), ("ARES", "1440.0"), ("AFRT", "front")),
        *(("AMIN", "-1"), ("AMAX", "10000"), ("AFRT", "-1"), ("AFRT", "9" * 400)),
    ],
)
def test_a_value_that_no_laser_has_is_refused_by_its_name(key: str, value: str):
    with pytest.raises(ProtocolError, match=f"PP: {key} is {value[:20]}, expected"):
        Geometry.of(REAL | {key: value})


def test_a_line_that_is_missing_is_refused_by_its_name():
    with pytest.raises(ProtocolError, match="PP: AFRT is missing, expected 0 to 9999"):
        Geometry.of({key: value for key, value in REAL.items() if key != "AFRT"})


@pytest.mark.parametrize(
    "turned",
    [{"DMIN": "60000"}, {"AMIN": "1080"}, {"AFRT": "1081"}, {"AMIN": "541"}, {"ARES": "1080"}, {"ARES": "4"}],
)
def test_limits_that_contradict_each_other_are_refused(turned: dict[str, str]):
    with pytest.raises(ProtocolError, match="describes no laser"):
        Geometry.of(REAL | turned)
