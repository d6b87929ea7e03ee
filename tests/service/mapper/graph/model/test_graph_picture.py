from dataclasses import replace

import numpy as np

from service.mapper.graph.model.graph_picture import MAX_PLOTTED, draw, draw_saved, stretches
from service.mapper.loop_evidence import RefusedLoops
from tests.service.mapstore.tile_makers import graph_of

NONE = np.empty((0, 2), np.int64)


def test_a_long_path_is_thinned_and_keeps_its_end() -> None:
    count = 10 * MAX_PLOTTED + 1
    xy = np.column_stack((np.arange(count, dtype=float), np.zeros(count)))
    loops = np.column_stack((np.arange(2000), np.arange(2000) + 3000))
    (path,) = (picture := draw(1, xy, np.zeros(count, np.int64), loops, NONE)).paths
    assert MAX_PLOTTED / 2 < len(path) <= MAX_PLOTTED + 1
    assert path[-1].tolist() == [count - 1, 0.0]
    assert len(picture.accepted) == MAX_PLOTTED
    assert picture.accepted[[0, -1], 0, 0].tolist() == [0.0, 1999.0]


def test_a_polyline_ends_at_another_segment_another_session_and_a_gap() -> None:
    path_length_m = np.array([0.0, 1.0, 2.0, 103.0, 104.0, 105.0, 106.0])
    segment = np.array([0, 0, 0, 0, 1, 1, 1])
    known = np.array([True, True, True, True, True, False, True])
    numbers = stretches(path_length_m, segment, known)
    assert numbers[:3].tolist() == [0, 0, 0]
    assert numbers[5] == -1
    assert len(set(numbers.tolist())) == 5
    assert stretches(np.empty(0), np.empty(0, np.int64), np.empty(0, np.bool_)).tolist() == []


def test_a_stored_graph_shows_its_key_frames_and_its_loops() -> None:
    graph = replace(
        graph_of(4),
        is_lost=np.arange(4) == 3,
        loop_ends=np.array([(0, 2)]),
        refused=RefusedLoops(np.array([(1, 2), (0, 3)])),
    )
    picture = draw_saved(graph)
    xy = graph.map[:, :2].astype(np.float32)
    np.testing.assert_array_equal(picture.paths, [xy[:3]])
    np.testing.assert_array_equal(picture.accepted, [xy[[0, 2]]])
    np.testing.assert_array_equal(picture.refused, [xy[[1, 2]]])
    assert (picture.stamp_ns, len(picture.borders)) == (3, 0)
