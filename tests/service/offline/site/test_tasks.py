"""Loops between sessions of which one is bent."""

from dataclasses import replace

import numpy as np

from service.geometry import poses as se2
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.saved_graph import SavedGraph
from service.offline.site.tasks import FindLoops, keep_graph
from tests.service.mapper.graph.loops import rings

BENT_FROM, STRAIGHT_FROM = 35, 45  # key frames of the second session
JUMP = np.array([0.3, 0.0, 0.0])  # m, m, rad there


def test_loops_to_a_bent_end_are_kept_for_the_graph_of_all_sessions(monkeypatch, tmp_path):
    """Loops between the first two, which would straighten the second, are missing here."""
    monkeypatch.setattr(rings, "BEAMS", 91)
    monkeypatch.setattr(rings, "STEP_RAD", -2.0 * rings.FIRST_RAD / 90)
    first, second, third = (driven(seed) for seed in range(3))
    sessions = (first, bent(second))
    files = [keep_graph(one, tmp_path / str(k)) for k, one in enumerate((*sessions, third))]
    _, to_second = FindLoops("third", tuple(files[:2]), files[2], "").work().outcome["loops"]
    ends = [loop for loop in to_second if loop.of >= STRAIGHT_FROM]
    assert len(ends) == 3
    off = [se2.between(loop.measured, se2.between(second.map[loop.of], third.map[loop.to])) for loop in ends]
    assert np.hypot(*np.array(off)[:, :2].T).max() < 0.05


def driven(seed: int) -> SavedGraph:
    """Half a round of the ring."""
    frames, _ = rings.key_frames(0.6, seed, turn_error_radpm=0.0)
    saved = LoopBackEnd(LoopsConfig(), None).work(Batch(frames, is_last=True)).saved
    assert isinstance(saved, SavedGraph)
    return saved


def bent(graph: SavedGraph) -> SavedGraph:
    """The graph with a wrong step, and steps that pass for precise."""
    moved = graph.map.copy()
    step = se2.between(moved[BENT_FROM - 1], moved[BENT_FROM:])
    moved[BENT_FROM:] = se2.compose(se2.compose(moved[BENT_FROM - 1], JUMP), step)
    return replace(graph, map=moved, odom=moved, covariance=1e-4 * graph.covariance)
