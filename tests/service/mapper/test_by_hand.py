"""Manual edits move with the map around them."""

from dataclasses import replace

import numpy as np
import pytest

from service.geometry import poses as se2
from service.mapper.by_hand import DRAWN_WALL, ERASED, ByHand, Drawing
from service.mapper.components import AreaToErase, ScanToRender, WallToRender
from service.mapper.drawn_by_hand import among_scans, walls_of
from service.mapper.maps.occupancy import cells_of_wall
from service.mapper.saved_graph import SavedGraphError
from tests.service.mapstore.tile_makers import graph_of

POSES = np.array([(0.0, 0.0, 0.0), (5.0, 0.0, 1.0), (10.0, 0.0, -2.0), (15.0, 0.0, 0.5)])
LINE = np.array([(9.0, 2.0), (11.0, 2.0)])
AREA = np.array([(4.0, 1.0), (6.0, 1.0), (6.0, 2.0)])


@pytest.fixture
def edits() -> ByHand:
    by_hand = (
        ByHand()
        .with_drawing(Drawing(DRAWN_WALL, 4, LINE), POSES)
        .with_drawing(Drawing(ERASED, 4, AREA), POSES)
    )
    return by_hand.with_point_pair((0, 2), np.array([(1.0, 0.0), (-9.0, 0.0)]))


def test_edits_keep_their_place_and_move_with_the_nearest_key_frame(edits):
    wall, area = edits.drawings(POSES)
    np.testing.assert_allclose(wall.corners_map, LINE, atol=1e-12)
    np.testing.assert_allclose(area.corners_map, AREA, atol=1e-12)
    bent = POSES.copy()
    bent[2] = se2.compose(np.array((1.0, 1.0, 0.0)), POSES[2])
    wall, area = edits.drawings(bent)
    np.testing.assert_allclose(wall.corners_map, LINE + 1.0, atol=1e-12)
    np.testing.assert_allclose(area.corners_map, AREA, atol=1e-12)


def test_areas_follow_the_scans_they_were_erased_from_and_walls_come_last(edits):
    edits = replace(edits, until=np.array([4, 2]))
    scans = [(k, ScanToRender(np.zeros((0, 2), np.float32), (0.0, 0.0), None)) for k in (0, 1, 3)]
    kinds = [type(one) for one in among_scans(scans, edits, POSES)]
    assert kinds == [ScanToRender, ScanToRender, AreaToErase, ScanToRender, WallToRender]


def test_an_area_erases_only_walls_drawn_before_it(edits):
    (wall,) = walls_of(edits.with_drawing(Drawing(DRAWN_WALL, 4, LINE), POSES), POSES)[1:]
    assert len(cells_of_wall(wall, 0.1)) > 20
    over = np.array([(8.0, 1.0), (10.0, 1.0), (10.0, 3.0), (8.0, 3.0)])
    (wall,) = walls_of(edits.with_drawing(Drawing(ERASED, 4, over), POSES), POSES)
    columns = cells_of_wall(wall, 0.1)[:, 1]
    assert (columns.min(), columns.max()) == (100, 110)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("corner_keyframe", np.full(5, 4)),
        ("corner_of", np.full(5, 2)),
        ("until", np.array([4, 5])),
        ("pair_ends", np.array([[0, -1]])),
        ("pair_xy", np.full((1, 2, 2), np.nan)),
        ("corner_xy", np.zeros((4, 2))),
    ],
)
def test_arrays_that_do_not_fit_the_graph_are_refused_by_name(edits, name, wrong):
    graph = replace(graph_of(4), by_hand=replace(edits, **{name: wrong}))
    with pytest.raises(SavedGraphError, match=f"by_hand_{name}"):
        graph.checked()


def test_without_its_key_frame_an_edit_moves_to_the_next_one(edits):
    left = np.array([True, True, False, True])
    cut = edits.without_keyframes(left, POSES)
    wall, area = cut.drawings(POSES[left])
    np.testing.assert_allclose(wall.corners_map, LINE, atol=1e-12)
    np.testing.assert_allclose(area.corners_map, AREA, atol=1e-12)
    assert area.until == 3
    assert len(cut.pair_ends) == 0
    assert edits.without_keyframes(np.array([True, False, True, True]), POSES).pair_ends.tolist() == [[0, 1]]
