import pytest

from service.encoding import IMU, LASER_SCAN
from service.encoding.steps import decode_step
from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.mapper.mapping_session import LeftOut
from service.mapstore.tiles import TileStore
from service.runtime.mapper_messages import FrameItem, Hello, PassedOver, Status
from service.runtime.mapping_outputs import MappingOutputs
from tests.service.mapstore.tile_makers import tile

GEO = GeoReference(LocalFrame(60.161, 24.546, 51.7), SE2(3.0, -4.0, 0.0), 0.8, 0.01, 41)


def test_where_the_map_lies_goes_to_the_tiles_and_ends_with_the_map():
    tiles = TileStore()
    outputs = MappingOutputs(["front"], tiles, lambda *_: None, lambda *_: None, lambda: 0)
    tiles.update([tile(0, 0, 1)])
    outputs.heard(Status(1, geo_reference=GEO))
    assert outputs.geo_reference == GEO
    assert tiles.take()[1].geo == GEO
    assert outputs.map_reset() == 1
    assert outputs.geo_reference is None
    (ended,), present = tiles.take()
    assert (ended.geo, present.geo) == (GEO, None)
    outputs.heard(Status(2))
    assert tiles.take()[1].geo is None
    assert outputs.map_reset() is None  # it had no tile


def test_a_message_that_no_one_takes_is_not_lost_in_silence():
    outputs = MappingOutputs(["front"], TileStore(), lambda *_: None, lambda *_: None, lambda: 0)
    with pytest.raises(AssertionError, match="Hello"):
        outputs.heard(Hello(1, 0, is_standby=False))


def test_a_replay_leaves_out_what_the_mapper_was_not_given_and_scans_of_it_count_as_an_overload():
    events = []
    outputs = MappingOutputs(
        ["front"], TileStore(), lambda message, _: events.append(message), lambda *_: None, lambda: 0
    )
    for log_ns, sensor, kind in ((10, "imu", IMU), (20, "front", LASER_SCAN), (30, "rear", LASER_SCAN)):
        outputs.left_out(FrameItem(1, log_ns, 0, sensor, kind, b""))
    outputs.heard(PassedOver(1, 40, "front", 70_000_000))
    outputs.left_out(FrameItem(2, 50, 0, "front", LASER_SCAN, b""))
    assert [decode_step(event.payload, event.log_ns) for event in events] == [
        LeftOut("imu", "fatal", 9),
        LeftOut("front", "fatal", 19),
        LeftOut("rear", "fatal", 29),
        LeftOut("front", "old", 39),
        LeftOut("front", "fatal", 49),
    ]
    assert outputs.passed_over == {"front": 3}
    assert outputs.overload().startswith("3 scans in ")
    assert "having waited up to 70 ms" in outputs.overload()
