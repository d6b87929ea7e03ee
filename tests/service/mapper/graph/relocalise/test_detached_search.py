"""What is reported of a segment after one search result."""

from itertools import pairwise

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.model.keyframe_list import KeyframeList, LoopsConfig
from service.mapper.graph.relocalise.detached_search import DetachedSearch
from service.mapper.judgement import GAP_S
from tests.service.mapper.graph.key_frames import STOOD, Walls, append, room, rooms

JUNCTION = [  # of two bare corridors, 3 and 2 m wide
    (2.0, -12.0, 2.0, 12.0),
    (-1.0, -12.0, -1.0, -1.0),
    (-1.0, 1.0, -1.0, 12.0),
    (-15.0, -1.0, -1.0, -1.0),
    (-15.0, 1.0, -1.0, 1.0),
    (-15.0, -1.0, -15.0, 1.0),
]
BOXES = [(-4.5, 0.5), (-3.0, -1.0), (-2.6, 0.6), (0.5, -0.9), (0.6, 0.8), (0.6, -2.5)]  # 0.4 m wide
IN_JUNCTION = SE2(-3.5, 0.1, 0.2)


def junction(with_boxes: bool, at_m: float = 0.0) -> Walls:
    boxes = [
        (*a, *b)
        for x, y in (BOXES if with_boxes else [])
        for a, b in pairwise([(x, y), (x + 0.4, y), (x + 0.4, y + 0.4), (x, y + 0.4), (x, y)])
    ]
    return [(x0 + at_m, y0, x1 + at_m, y1) for x0, y0, x1, y1 in [*JUNCTION, *boxes]]


def searched(known: Walls, seen: Walls) -> DetachedSearch:
    """Past a junction and into it; and then what a vehicle sees that was carried 100 m."""
    keyframes, noise = KeyframeList(), np.random.default_rng(5)
    for y_m in np.arange(-5.0, 5.1, 0.5):
        append(keyframes, known, SE2(0.0, float(y_m), 0.5 * np.pi), 0, noise)
    for x_m in np.arange(-0.5, -3.1, -0.5):
        append(keyframes, known, SE2(float(x_m), 0.0, np.pi), 0, noise)
    mapped = np.arange(keyframes.count)
    at = SE2(IN_JUNCTION.x_m + 100.0, IN_JUNCTION.y_m, IN_JUNCTION.theta_rad)
    append(keyframes, seen, at, 1, noise)
    search = DetachedSearch(LoopsConfig(), keyframes)
    assert search.find(mapped) is None
    return search


def test_walls_common_to_all_wings_do_not_localise() -> None:
    """The entire query lies on the map, and may be another junction of bare corridors."""
    search = searched(junction(False), junction(False, at_m=100.0))
    assert search.unconfirmed_place is None
    (possible,) = search.possible
    assert (possible.x_m, possible.y_m) == pytest.approx((IN_JUNCTION.x_m, IN_JUNCTION.y_m), abs=0.2)
    assert possible.least is not None
    assert 5.0 < possible.nats < possible.least


def test_a_junction_with_objects_is_found() -> None:
    search = searched(junction(True), junction(True, at_m=100.0))
    found = search.unconfirmed_place
    assert found is not None
    assert search.possible == []
    at = found.pose_map_odom @ SE2(IN_JUNCTION.x_m + 100.0, IN_JUNCTION.y_m, IN_JUNCTION.theta_rad)
    assert (at.x_m, at.y_m) == pytest.approx((IN_JUNCTION.x_m, IN_JUNCTION.y_m), abs=0.02)


def test_unknown_ground_does_not_contradict_a_place() -> None:
    """Half of the query is new: a segment that comes from new ground is found at the border of the map."""
    new = [(-15.0, 1.0, -6.5, 4.0), (-6.5, 4.0, -5.5, 4.0), (-5.5, 4.0, -5.5, 1.0), (-5.5, 1.0, -1.0, 1.0)]
    seen = [wall for wall in junction(True) if wall != JUNCTION[4]] + new
    search = searched(junction(True), [(x0 + 100.0, y0, x1 + 100.0, y1) for x0, y0, x1, y1 in seen])
    assert search.unconfirmed_place is not None


@pytest.mark.parametrize("gap_s", [0.5, 15.0])
def test_after_driving_on_rooms_out_of_reach_are_not_searched(gap_s: float) -> None:
    keyframes, noise = rooms(pillar_in_first=False, pillar_in_second=False)
    mapped = np.arange(keyframes.count)
    append(keyframes, room(0.0, with_pillar=False), STOOD, 1, noise, gap_s=gap_s)
    search = DetachedSearch(LoopsConfig(), keyframes)
    search.find(mapped)
    assert len(search.possible) == (2 if gap_s > GAP_S else 0)
    assert (search.unconfirmed_place is None) == (gap_s > GAP_S)
