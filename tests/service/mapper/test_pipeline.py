import math

from drivers.frames import GnssFix
from service.mapper.profiles import build_mapper, mapping_config


def test_gnss_fixes_are_passed_over_and_counted():
    mapper = build_mapper(mapping_config(), {})
    lost = GnssFix("imu", 2, 3, -1, math.nan, math.nan, math.nan, (0.0,) * 9)
    for fix in (GnssFix("imu", 1, 2, 0, 60.1, 24.5, 51.0, (0.0,) * 9), lost):
        assert mapper.process(fix) is None
    assert mapper.counters == {"fixes_passed_over": 2}
