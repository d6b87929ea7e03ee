"""Manual changes of a stored graph: a ring of corridors, driven one and a half times."""

from dataclasses import replace

import numpy as np
import pytest

from service.geometry import poses as se2
from service.geometry.polygons import is_inside
from service.mapper.graph.edit.editing import (
    EditError,
    groups,
    solved,
    with_area_erased,
    with_pair,
    with_wall,
    without_loops,
    without_pair,
    without_time,
)
from service.mapper.graph.loops.loop_back_end import LoopBackEnd
from service.mapper.graph.loops.loop_batches import Batch
from service.mapper.graph.model.loops_config import LoopsConfig
from service.mapper.maps.occupancy import OccupancyConfig, OccupancyTiles
from service.mapper.saved_graph import SavedGraph
from tests.service.mapper.graph.loops.rings import LENGTH_M, STEP_M, WIDTH_M, key_frames

ROUND = round(2.0 * (LENGTH_M + WIDTH_M) / STEP_M)  # key frames
TENTH_NS = 10**8  # from one key frame of the ring to the next
CABINET = np.array([(3.7, -0.9), (4.9, -0.9), (4.9, -0.4), (3.7, -0.4)])
RENDERER = OccupancyTiles(OccupancyConfig(), 0.05).renderer


def saved_of(rounds: float, config: LoopsConfig | None = None) -> SavedGraph:
    frames, _ = key_frames(rounds)
    back_end = LoopBackEnd(config or LoopsConfig(), None)
    for k in range(0, len(frames), 7):
        back_end.work(Batch(frames[k : k + 7]))
    saved = back_end.work(Batch([], is_last=True)).saved
    assert isinstance(saved, SavedGraph)
    return saved


@pytest.fixture(scope="module")
def ring() -> SavedGraph:
    graph = saved_of(1.4)
    assert len(graph.loop_ends) >= 3
    return graph


@pytest.fixture(scope="module")
def open_ring() -> SavedGraph:
    """The same without accepted loops: the second round is offset from the first."""
    return saved_of(1.4, LoopsConfig(consensus_span_m=1000.0))


def points_map(graph: SavedGraph) -> np.ndarray:
    of = np.repeat(np.arange(len(graph)), graph.point_count)
    return se2.points_from(graph.map[of], graph.xy_base.astype(np.float64))


def test_of_an_erased_area_no_point_is_left_and_all_others_are(ring: SavedGraph):
    within = is_inside(points_map(ring), CABINET)
    erased, gone = with_area_erased(ring, CABINET, "unknown")
    assert gone == within.sum() > 100
    erased.checked()
    np.testing.assert_array_equal(points_map(erased), points_map(ring)[~within])
    np.testing.assert_array_equal(erased.map, ring.map)
    (area,) = erased.by_hand.drawings(erased.map)
    np.testing.assert_allclose(area.corners_map, CABINET, atol=1e-9)
    assert area.until == len(ring)


def test_solving_a_solved_graph_moves_nothing(ring: SavedGraph):
    again = solved(ring, RENDERER)
    assert again.contradicted == 0
    assert again.moved_m.max() < 0.001


def test_a_cut_takes_the_key_frames_of_its_time_and_nothing_else(ring: SavedGraph):
    """The other pass saw both ends, so loops connect the rest."""
    first, last = ROUND // 4, ROUND // 4 + 10
    cut = without_time(ring, first * TENTH_NS, (last - 1) * TENTH_NS, is_bridged=False)
    cut.checked()
    assert len(cut) == len(ring) - 10
    np.testing.assert_array_equal(cut.stamp_ns, np.delete(ring.stamp_ns, np.arange(first, last)))
    assert len(np.unique(cut.segment)) == 2
    assert set(groups(cut).tolist()) == {0}
    stamps = {tuple(ring.stamp_ns[ends]) for ends in ring.loop_ends}
    assert {tuple(cut.stamp_ns[ends]) for ends in cut.loop_ends} <= stamps
    after = solved(cut, RENDERER)
    assert after.moved_m.max() < 0.05


def test_a_cut_that_disconnects_the_map_is_refused_with_its_parts(open_ring: SavedGraph):
    with pytest.raises(
        EditError, match=r"2 parts .* disconnected: 40 key frames between .* from 4.60 s on. --bridge"
    ):
        without_time(open_ring, 40 * TENTH_NS, 45 * TENTH_NS, is_bridged=False)
    bridged = without_time(open_ring, 40 * TENTH_NS, 45 * TENTH_NS, is_bridged=True)
    assert len(bridged) == len(open_ring) - 6
    assert set(groups(bridged).tolist()) == {0}


def test_the_begin_and_the_end_can_be_cut_off_without_a_bridge(open_ring: SavedGraph):
    begun = without_time(open_ring, 0, 40 * TENTH_NS, is_bridged=False)
    np.testing.assert_array_equal(begun.map, open_ring.map[41:])
    ended = without_time(open_ring, 100 * TENTH_NS, 10**18, is_bridged=False)
    assert len(ended) == 100
    assert len(np.unique(ended.segment)) == 1


def test_a_cut_of_nothing_or_of_all_is_refused(ring: SavedGraph):
    with pytest.raises(EditError, match="no key frame lies in that time"):
        without_time(ring, 10**18, 2 * 10**18, is_bridged=False)
    with pytest.raises(EditError, match="that is all of the map"):
        without_time(ring, 0, 10**18, is_bridged=False)


def test_pairs_close_a_ring_that_no_loop_has_closed(open_ring: SavedGraph):
    """The operator marks three points in both passes; afterwards they coincide."""
    graph = open_ring
    truth = key_frames(1.4)[1]
    spots = (8, 30, 52)
    for k in spots:
        wall_base = graph.xy_base[graph.point_count[:k].sum()].astype(np.float64)
        true_map = truth[k] @ type(truth[k])(float(wall_base[0]), float(wall_base[1]), 0.0)
        seen_later = truth[k + ROUND].inverse() @ true_map
        later = se2.points_from(graph.map[k + ROUND], np.array([seen_later.x_m, seen_later.y_m]))
        graph = with_pair(graph, np.stack((se2.points_from(graph.map[k], wall_base), later)), (k, k + ROUND))
    before = seam_m(graph, truth)
    assert before.min() > 0.5
    after = solved(graph, RENDERER)
    assert seam_m(after.graph, truth).max() < 0.1
    assert after.moved_m.max() > 0.3
    back = without_pair(without_pair(without_pair(after.graph, 1), 0), 0)
    assert len(back.by_hand.pair_ends) == 0


def seam_m(graph: SavedGraph, truth) -> np.ndarray:
    off = []
    for a in range(5, len(truth) - ROUND - 5, 5):
        here = se2.between(graph.map[a], graph.map[a + ROUND])
        true = truth[a].inverse() @ truth[a + ROUND]
        off.append(np.hypot(here[0] - true.x_m, here[1] - true.y_m))
    return np.array(off)


def test_a_pair_is_tied_to_the_passes_that_saw_its_points(open_ring: SavedGraph):
    of_first = points_map(open_ring)[open_ring.point_count[:10].sum() + 50]
    k = 10 + ROUND
    of_second = points_map(open_ring)[open_ring.point_count[:k].sum() + 50]
    paired = with_pair(open_ring, np.stack((of_first, of_second)))
    first, second = paired.by_hand.pair_ends[0].tolist()
    assert abs(open_ring.path_length_m[first] - open_ring.path_length_m[second]) > 10.0
    seen = se2.points_from(open_ring.map[[first, second]], paired.by_hand.pair_xy[0])
    np.testing.assert_allclose(seen, np.stack((of_first, of_second)), atol=1e-9)


def test_a_pair_no_key_frame_saw_is_refused(ring: SavedGraph):
    nowhere = np.array([(100.0, 100.0), (101.0, 100.0)])
    with pytest.raises(EditError, match=r"the first point at \(100.00, 100.00\) m was seen by no key frame"):
        with_pair(ring, nowhere)
    with pytest.raises(EditError, match="there is no key frame 9999"):
        with_pair(ring, nowhere, (0, 9999))
    with pytest.raises(EditError, match="both points are of key frame 3"):
        with_pair(ring, nowhere, (3, 3))
    with pytest.raises(EditError, match="there is no pair 0; there is no pair at all"):
        without_pair(ring, 0)


def test_a_loop_is_removed_and_the_others_stay(ring: SavedGraph):
    less = without_loops(ring, [1])
    less.checked()
    np.testing.assert_array_equal(less.loop_ends, np.delete(ring.loop_ends, 1, axis=0))
    with pytest.raises(EditError, match=f"there is no accepted loop {len(ring.loop_ends)}"):
        without_loops(ring, [len(ring.loop_ends)])
    none = without_loops(ring, range(len(ring.loop_ends)))
    opened = solved(none, RENDERER)
    np.testing.assert_array_equal(opened.graph.map, ring.map)  # with nothing to agree with, nothing moves


def test_the_only_loop_of_a_segment_is_not_removed(ring: SavedGraph):
    segment = ring.segment.copy()
    segment[ROUND:] = 7
    torn = replace(ring, segment=segment)
    with pytest.raises(EditError, match="2 parts of the map would be disconnected"):
        without_loops(torn, range(len(ring.loop_ends)))


def test_walls_and_areas_move_with_the_solved_graph(open_ring: SavedGraph):
    k = 20 + ROUND
    wall = se2.points_from(open_ring.map[k], np.array([(1.0, 0.0), (1.0, 0.5)]))
    drawn = with_wall(open_ring, wall)
    moved = drawn.map.copy()
    moved[ROUND:, :2] += 1.0
    (drawing,) = drawn.by_hand.drawings(moved)
    np.testing.assert_allclose(drawing.corners_map, wall + 1.0, atol=1e-9)
    assert len(solved(drawn, RENDERER).rendered_map.wall_cells) > 8
