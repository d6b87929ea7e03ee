import pytest

from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.mapstore.tiles import TileStore
from service.runtime.mapper_messages import Hello, Status
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
