import math
from dataclasses import replace

import numpy as np

from drivers.frames import GnssFix, LaserScan
from service.geometry.se2 import SE2
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from tests.service.mapper.drives import MOUNTING, ROOM, drive, standing


def test_gnss_fixes_are_passed_over_and_counted():
    mapper = build_mapper(mapping_config(), {})
    lost = GnssFix("imu", 2, 3, -1, math.nan, math.nan, math.nan, (0.0,) * 9)
    for fix in (GnssFix("imu", 1, 2, 0, 60.1, 24.5, 51.0, (0.0,) * 9), lost):
        assert mapper.process(fix) is None
    assert mapper.counters == {"fixes_passed_over": 2}


def test_nothing_is_painted_while_lost_and_a_piece_is_mapped_apart():
    """The laser is carried into another room, where the vehicle is said to stand still."""
    mapper: Mapper = build_mapper(mapping_config(), {"front": MOUNTING})
    here = drive(ROOM, standing, 1.2)
    other = [tuple(2.5 * v for v in wall) for wall in ROOM[:6]]
    there = drive(other, lambda t: SE2(3.0, 3.0, 2.0), 0.6)
    for frame in here.frames:
        mapper.process(frame)
    assert mapper.changed_tiles()
    last_ns = max(frame.stamp_ns for frame in here.frames)
    states = []
    for frame in there.frames:
        if not isinstance(frame, LaserScan):
            continue
        scan = replace(
            frame, stamp_ns=frame.stamp_ns - 10**9 + last_ns, arrived_ns=frame.arrived_ns - 10**9 + last_ns
        )
        output = mapper.process(scan)
        assert output is not None
        states.append(output.state)
    assert states.count("lost") == len(states) > 10
    assert mapper.changed_tiles() == []
    local_map = mapper._stages.local_map
    assert local_map.detached is not None
    assert local_map.detached.scan_count > 5
    assert np.isfinite(output.covariance).all()
