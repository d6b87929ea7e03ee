"""Maps of two drives made one."""

import math

import numpy as np
import pytest

from service.geometry.se2 import SE2
from service.mapper.graph.edit.merging import MergeError, merge_graphs, together
from service.mapper.profiles import mapping_config
from service.mapper.saved_graph import SavedGraph
from tests.service.mapper.offices import mapped_office, through
from tests.simulated import Drive, run


def mapped(made: Drive) -> tuple[Drive, SavedGraph]:
    saved = run(mapping_config(), made).mapper.finish().update.saved
    assert isinstance(saved, SavedGraph)
    return made, saved


@pytest.fixture(scope="module")
def first() -> tuple[Drive, SavedGraph]:
    made, begin = mapped_office()
    return made, begin.graph


@pytest.fixture(scope="module")
def second() -> tuple[Drive, SavedGraph]:
    """It begins in the middle of the first drive and continues beyond it."""
    return mapped(through("office", 20.0, 4, stand_s=-12.0))


def away(a: SE2, b: np.ndarray) -> tuple[float, float]:
    left = a.inverse() @ SE2(*b.tolist())
    return math.hypot(left.x_m, left.y_m), abs(left.theta_rad)


def test_the_second_map_gets_its_true_pose_in_the_first(first, second):
    (first_drive, a), (second_drive, b) = first, second
    merged = merge_graphs(a, b, None)
    assert merged.finds >= 3
    saved = merged.result.saved
    assert isinstance(saved, SavedGraph)
    assert len(saved) == len(a) + len(b)
    for k in range(0, len(b), 7):
        stamp_ns = int(b.stamp_ns[k])
        true = first_drive.world_first.inverse() @ second_drive.world_first @ second_drive.at(stamp_ns)
        off_m, off_rad = away(true, saved.map[len(a) + k])
        assert off_m < 0.04
        assert off_rad < 0.01
    assert merged.residual_m.max() < 0.03


def test_a_given_pose_replaces_the_search(first, second):
    (first_drive, a), (second_drive, b) = first, second
    between = first_drive.world_first.inverse() @ second_drive.world_first
    given = np.array([between.x_m + 0.7, between.y_m, between.theta_rad + 0.05])
    merged = merge_graphs(a, b, None, given)
    assert isinstance(merged.result.saved, SavedGraph)
    off_m, _ = away(between, merged.result.saved.map[len(a)])
    assert off_m < 0.05


def test_maps_of_two_buildings_are_not_merged(first):
    _, elsewhere = mapped(through("library", 3.0, 1))
    with pytest.raises(MergeError, match="overlap too little"):
        merge_graphs(first[1], elsewhere, None)


def test_loops_and_segments_of_both_keep_their_key_frames(first, second):
    a, b = first[1], second[1]
    both = together(a, b)
    both.checked()
    np.testing.assert_array_equal(both.loop_ends[len(a.loop_ends) :] - len(a), b.loop_ends)
    assert not set(both.segment[: len(a)].tolist()) & set(both.segment[len(a) :].tolist())
    assert (
        both.path_length_m[len(a)] > a.path_length_m[-1] + 50.0
    )  # so that a loop between the two counts as one
