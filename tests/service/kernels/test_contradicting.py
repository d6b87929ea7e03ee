"""Which points of a scan contradict a sub-map: walls ahead of one sensor."""

import numpy as np
import pytest

from service.kernels.static_score import count_contradicting
from tests.service.kernels.test_dynamic_filter import POSE, SENSOR, SETTINGS, CandidateSubmap, wall

COUNT = 161
MOST = 0.85 * COUNT  # some beams pass between two surfels, or begin beside what is known
NEAR_M, FAR_M = 2.0, 3.0


@pytest.fixture(scope="module")
def place() -> CandidateSubmap:
    """A wall at NEAR_M, wider than the points tested, with unknown ground behind it."""
    made = CandidateSubmap()
    for _ in range(4):
        made.see(*wall(NEAR_M, 0.6, 400))
    return made


def contradicting(place: CandidateSubmap, xy, normals, sensor=SENSOR, behind_m=SETTINGS.behind_m):
    return count_contradicting(xy, sensor, normals, POSE, place.grid, place.observations, behind_m)


def test_what_lies_behind_a_wall_on_ground_that_no_one_knows_is_behind(place: CandidateSubmap) -> None:
    in_free, behind = contradicting(place, *wall(FAR_M))
    assert in_free == 0
    assert behind > MOST


def test_what_lies_on_the_wall_or_close_behind_it_contradicts_nothing(place: CandidateSubmap) -> None:
    assert contradicting(place, *wall(NEAR_M)) == (0, 0)
    close = wall(NEAR_M + 0.25)
    assert contradicting(place, *close, behind_m=0.3) == (0, 0)
    in_free, behind = contradicting(place, *close, behind_m=0.2)
    assert in_free == 0
    assert behind > MOST


def test_what_lies_where_key_frames_looked_through_is_in_free_space() -> None:
    place = CandidateSubmap()
    for _ in range(SETTINGS.max_free):
        place.see(*wall(FAR_M, 0.6, 400))
    in_free, behind = contradicting(place, *wall(NEAR_M))
    assert in_free > MOST
    assert behind == 0
    beside = wall(FAR_M - 0.1)  # one cell before the wall is the wall
    assert contradicting(place, *beside) == (0, 0)


def test_points_without_weight_are_skipped(place: CandidateSubmap) -> None:
    xy, normals = wall(FAR_M)
    normals[:, 2] = 0.0
    assert contradicting(place, xy, normals) == (0, 0)


def test_a_wall_is_behind_no_one_whose_beams_begin_behind_it(place: CandidateSubmap) -> None:
    assert contradicting(place, *wall(FAR_M), sensor=np.array([2.5, 0.0])) == (0, 0)


def test_a_point_counts_once_however_many_walls_are_before_it() -> None:
    place = CandidateSubmap()
    for distance_m in (2.5, 2.0):
        for _ in range(4):
            place.see(*wall(distance_m, 0.6, 400))
    in_free, behind = contradicting(place, *wall(FAR_M))
    assert in_free == 0
    assert MOST < behind <= COUNT
    for on_second_m in (2.5, 2.4):  # on it, and one cell before it
        assert contradicting(place, *wall(on_second_m)) == (0, 0)


def test_a_point_in_free_space_is_not_behind_as_well() -> None:
    place = CandidateSubmap()
    for _ in range(SETTINGS.max_free):
        place.see(*wall(FAR_M, 0.6, 400))
    for _ in range(2 * SETTINGS.max_free):
        place.see(*wall(1.0, 0.6, 400))
    in_free, behind = contradicting(place, *wall(NEAR_M))
    assert in_free > MOST
    assert behind <= COUNT - in_free
