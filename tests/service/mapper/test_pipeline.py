import math
from dataclasses import replace

import numpy as np
import pytest

from drivers.frames import GnssFix, LaserScan
from service.geometry.geo_reference import GeoReference
from service.geometry.geodesy import LocalFrame
from service.geometry.se2 import SE2
from service.mapper.graph.no_graph import NoGraph
from service.mapper.pipeline import Mapper
from service.mapper.profiles import build_mapper, mapping_config
from service.mapper.stages import GraphUpdate
from tests.service.mapper.drives import MOUNTING, ROOM, drive, standing


@pytest.mark.parametrize("profile", ["contour_lm", "submap_graph"])
def test_fixes_are_counted_and_passed_over_where_no_graph_takes_them(profile):
    mapper = build_mapper(mapping_config({"profile": profile}), {})
    lost = GnssFix("imu", 2, 3, -1, math.nan, math.nan, math.nan, (0.0,) * 9)
    for fix in (GnssFix("imu", 1, 2, 0, 60.1, 24.5, 51.0, (0.0,) * 9), lost):
        assert mapper.process(fix) is None
    assert mapper.counters == {"fixes_passed_over": 2}


class TalkingGraph(NoGraph):
    """Names a counter for each fix, and tells where the map lies when it is asked."""

    reference = GeoReference(LocalFrame(60.1, 24.5, 51.0), SE2(1.0, 2.0, 0.5), 0.7, 0.01, 40)

    def add_fix(self, fix):
        return "fixes_taken"

    def take_in(self):
        return GraphUpdate({}, geo=self.reference)


def test_where_the_map_lies_on_the_earth_stays_with_the_mapper_and_goes_out_with_each_pose():
    mapper: Mapper = build_mapper(mapping_config({"profile": "contour_lm"}), {"front": MOUNTING})
    mapper._stages = replace(mapper._stages, graph=TalkingGraph())
    frames = iter(drive(ROOM, standing, 0.6).frames)
    before = next(output for frame in frames if (output := mapper.process(frame)) is not None)
    assert before.geo_reference is None
    mapper.process(GnssFix("imu", 1, 2, 0, 60.1, 24.5, 51.0, (1.0,) * 9))
    assert mapper.counters["fixes_taken"] == 1
    mapper.take_in()
    after = next(output for frame in frames if (output := mapper.process(frame)) is not None)
    assert after.geo_reference is mapper.geo_reference is TalkingGraph.reference


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
