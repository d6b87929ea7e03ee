"""Searches of sessions in a site, and loops between sessions of which one is bent."""

from dataclasses import replace

import numpy as np
import pytest

from service.geometry import poses as se2
from service.mapper.graph.loops.loop_back_end import Batch, LoopBackEnd
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.graph.relocalise import detached_search
from service.mapper.graph.relocalise.known_map import KnownMap
from service.mapper.saved_graph import SavedGraph
from service.offline.site import tasks
from service.offline.site.tasks import Find, FindLoops, keep_graph
from tests.service.mapper.graph.loops import rings

BENT_FROM, STRAIGHT_FROM = 35, 45  # key frames of the second session
JUMP = np.array([0.3, 0.0, 0.0])  # m, m, rad there


@pytest.fixture(autouse=True)
def _few_beams(monkeypatch):
    monkeypatch.setattr(rings, "BEAMS", 91)
    monkeypatch.setattr(rings, "STEP_RAD", -2.0 * rings.FIRST_RAD / 90)


def test_the_sessions_of_a_round_are_searched_in_one_known_map(monkeypatch, tmp_path):
    built = []

    class Counted(KnownMap):
        def __init__(self, *of):
            built.append(self)
            super().__init__(*of)

    for module in (tasks, detached_search):
        monkeypatch.setattr(module, "KnownMap", Counted)
    site, *own = (keep_graph(driven(seed), tmp_path / str(seed)) for seed in range(3))
    finds = [Find(one.name, (site,), one, "") for one in own]
    outcomes = [find.work().outcome for find in finds]
    assert len(built) == 1
    monkeypatch.setattr(tasks, "_searched", tasks._Searched())
    assert finds[1].work().outcome == outcomes[1]  # as it is without the search before
    other = keep_graph(driven(3), tmp_path / "other")
    assert Find("other", (other,), own[0], "").work().outcome != outcomes[0]
    assert len(built) == 3


def test_loops_to_a_bent_end_are_kept_for_the_graph_of_all_sessions(tmp_path):
    """Loops between the first two, which would straighten the second, are missing here."""
    first, second, third = (driven(seed) for seed in range(3))
    files = [keep_graph(one, tmp_path / str(k)) for k, one in enumerate((first, bent(second), third))]
    _, to_second = FindLoops("third", tuple(files[:2]), files[2], "").work().outcome["loops"]
    ends = [loop for loop in to_second if loop.of >= STRAIGHT_FROM]
    assert len(ends) == 3
    off = [se2.between(loop.measured, se2.between(second.map[loop.of], third.map[loop.to])) for loop in ends]
    assert np.hypot(*np.array(off)[:, :2].T).max() < 0.05


def driven(seed: int) -> SavedGraph:
    """Half a round of the ring."""
    frames, _ = rings.key_frames(0.6, seed, turn_error_radpm=0.0)
    return LoopBackEnd(LoopsConfig(), None).work(Batch(frames, is_last=True)).saved


def bent(graph: SavedGraph) -> SavedGraph:
    """The graph with a wrong step, and steps that pass for precise."""
    moved = graph.map.copy()
    step = se2.between(moved[BENT_FROM - 1], moved[BENT_FROM:])
    moved[BENT_FROM:] = se2.compose(se2.compose(moved[BENT_FROM - 1], JUMP), step)
    return replace(graph, map=moved, odom=moved, covariance=1e-4 * graph.covariance)
