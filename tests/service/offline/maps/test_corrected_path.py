"""The path driven, in a map that was bent and cut afterwards."""

from dataclasses import replace

import numpy as np

from service.geometry import poses as se2
from service.offline.past.result import corrected_path
from tests.service.mapper.graph.loops.rings import saved_of

TENTH_NS = 10**8


def test_the_path_meets_the_moved_key_frames_and_bends_evenly_between():
    """Four poses from one key frame to the next, the first of each lying on it."""
    graph = saved_of(0.3)
    count = len(graph) - 1
    ahead = np.tile([[0.0, 0, 0], [0.07, 0, 0], [0.14, 0.01, 0], [0.2, 0.02, 0.1]], (count, 1))
    stamp_ns = np.repeat(graph.stamp_ns[:-1], 4) + np.tile(TENTH_NS // 4 * np.arange(4), count)
    poses = se2.compose(np.repeat(graph.map[:-1], 4, axis=0), ahead)
    moved = graph.map.copy()
    moved[10:] = se2.compose(np.array([0.3, -0.1, 0.04]), graph.map[10:])
    expected = poses.copy()
    expected[40:] = se2.compose(np.array([0.3, -0.1, 0.04]), poses[40:])
    _, path = corrected_path(stamp_ns, poses, graph, replace(graph, map=moved))
    between = np.arange(36, 40)
    np.testing.assert_allclose(np.delete(path, between, 0), np.delete(expected, between, 0), atol=1e-9)
    whole = se2.compose(np.array([0.3, -0.1, 0.04]), poses[between])
    share = ((stamp_ns[between] - graph.stamp_ns[9]) / (graph.stamp_ns[10] - graph.stamp_ns[9]))[:, None]
    np.testing.assert_allclose(path[between], poses[between] + share * (whole - poses[between]), atol=1e-9)
    assert corrected_path(np.empty(0, np.int64), np.empty((0, 3)), graph, graph)[1].shape == (0, 3)
