import numpy as np

from service.mapper.graph.model.graph_picture import MAX_DRAWN, draw, draw_saved, stretches
from service.mapper.loop_evidence import RefusedLoops
from service.mapper.saved_graph import SavedGraph

NONE = np.empty((0, 2), np.int64)


def test_a_long_path_is_thinned_and_keeps_its_end() -> None:
    count = 10 * MAX_DRAWN + 1
    xy = np.column_stack((np.arange(count, dtype=float), np.zeros(count)))
    loops = np.column_stack((np.arange(2000), np.arange(2000) + 3000))
    (path,) = (picture := draw(1, xy, np.zeros(count, np.int64), loops, NONE)).paths
    assert MAX_DRAWN / 2 < len(path) <= MAX_DRAWN + 1
    assert path[-1].tolist() == [count - 1, 0.0]
    assert len(picture.accepted) == MAX_DRAWN
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
    n = 4
    graph = SavedGraph(
        stamp_ns=np.arange(n) + 5, odom=np.zeros((n, 3)), map=np.arange(3.0 * n).reshape(n, 3),
        path_length_m=np.arange(n, dtype=float), covariance=np.zeros((n, 3, 3)),
        score=np.ones(n), gap_s=np.zeros(n),
        segment=np.zeros(n, np.int64), is_lost=np.array([False, False, False, True]),
        range_sigma_m=np.full(n, 0.01),
        sensor_xy_m=np.zeros((n, 2)), point_count=np.zeros(n, np.int64),
        xy_base=np.zeros((0, 2), np.float32), normals=np.zeros((0, 3), np.float32),
        loop_ends=np.array([(0, 2)]), loop_measured=np.zeros((1, 3)), loop_covariance=np.zeros((1, 3, 3)),
        loop_score=np.ones(1), loop_points=np.zeros(1, np.int64), loop_against=np.zeros(1),
        refused=RefusedLoops(np.array([(1, 2), (0, 3)]), np.zeros((2, 3)), np.zeros(2), np.zeros(2, np.int64),
                             np.zeros(2), np.zeros(2, np.int64)),
    )  # fmt: skip
    picture = draw_saved(graph.checked())
    assert [path.tolist() for path in picture.paths] == [[[0, 1], [3, 4], [6, 7]]]
    assert picture.accepted.tolist() == [[[0, 1], [6, 7]]]
    assert picture.refused.tolist() == [[[3, 4], [6, 7]]]
    assert (picture.stamp_ns, len(picture.borders)) == (8, 0)
