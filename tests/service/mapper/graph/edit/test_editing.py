"""Parts of a stored graph."""

import numpy as np

from service.mapper.graph.edit.editing import only
from tests.service.mapper.graph.loops import rings


def test_the_graph_of_some_key_frames_has_their_points(monkeypatch):
    monkeypatch.setattr(rings, "BEAMS", 37)
    graph = rings.saved_of(0.1)
    is_kept = np.arange(len(graph)) % 3 == 1
    part = only(graph, is_kept)
    for k, of in enumerate(np.flatnonzero(is_kept).tolist()):
        np.testing.assert_array_equal(part.points_of(k), graph.points_of(of))
    assert len(part.xy_base) == len(part.normals) == graph.point_count[is_kept].sum() > 0
    assert len(only(graph, np.zeros(len(graph), np.bool_)).xy_base) == 0
