"""Two rounds of one ring that lie beside each other in the map are proposed to be joined."""

import numpy as np
import pytest

from service.mapper.graph.edit.editing import solved, with_pair
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.offline.maps.disagreeing_passes import POINTS, disagreeing_passes
from tests.service.offline.maps.bent_maps import ROUND, BentMap


def test_the_points_proposed_straighten_the_map_and_then_nothing_is_proposed(bent: BentMap):
    (proposed,) = disagreeing_passes(bent.graph)
    earlier, later = proposed["keyframes"]
    assert later - earlier == pytest.approx(ROUND, abs=10)
    assert proposed["apart_m"] > 0.5
    assert proposed["apart_deg"] == pytest.approx(6.0, abs=0.1)
    assert len(proposed["points"]) == POINTS
    graph = bent.graph
    for points in proposed["points"]:
        graph = with_pair(graph, np.array(points), (earlier, later))
    graph = solved(graph, OccupancyTiles(OccupancyConfig(), 0.05).renderer).graph
    assert bent.error_m(bent.graph) > 0.5
    assert bent.error_m(graph) < 0.10
    assert disagreeing_passes(graph) == []
