import numpy as np

from service.geometry.se2 import SE2
from service.mapper.maps.known_ground import KnownGround
from tests.service.mapper.maps.points import points_of, square


def test_a_scan_lies_on_the_ground_that_it_made_known_and_nowhere_else() -> None:
    ground = KnownGround()
    room = square()
    assert ground.overlap(room.xy_base, SE2()) == (0, 0)
    ground.insert(room, SE2(1.0, 2.0, 0.5))
    count = len(room.xy_base)
    assert ground.overlap(room.xy_base, SE2(1.0, 2.0, 0.5)) == (count, 0)
    on_map, in_free = ground.overlap(0.5 * room.xy_base, SE2(1.0, 2.0, 0.5))
    assert on_map == 0
    assert in_free > 0.95 * count
    assert ground.overlap(room.xy_base, SE2(80.0, 2.0, 0.5)) == (0, 0)


def test_what_stands_where_it_was_free_is_known_at_once_and_free_again_when_seen_through() -> None:
    ground = KnownGround()
    for _ in range(20):
        ground.insert(square(), SE2())
    thing = points_of(np.array([[1.0, 0.0]]))
    assert ground.overlap(thing.xy_base, SE2()) == (0, 1)
    ground.insert(thing, SE2())
    assert ground.overlap(thing.xy_base, SE2()) == (1, 0)
    for _ in range(4):
        ground.insert(square(), SE2())
    assert ground.overlap(thing.xy_base, SE2()) == (0, 1)
