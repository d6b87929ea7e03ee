"""What all graphs with a back end do when it is lost."""

from collections.abc import Callable

import pytest

from service.mapper.components import Graph, GraphRequestError
from service.mapper.graph.loops.loop_closing import LoopClosing
from service.mapper.graph.model.keyframe_list import LoopsConfig
from service.mapper.papers.submap_graph.graph.landmark_back_end import LandmarkGraphConfig
from service.mapper.papers.submap_graph.graph.landmark_graph import LandmarkGraph
from tests.service.mapper.discarding_worker import DiscardingWorker


def loop_closing() -> Graph:
    return LoopClosing(LoopsConfig(), None, DiscardingWorker)


def landmark_graph() -> Graph:
    return LandmarkGraph(LandmarkGraphConfig(), None, DiscardingWorker)


@pytest.mark.parametrize("new_graph", [loop_closing, landmark_graph])
def test_lost_work_is_counted_and_reported(new_graph: Callable[[], Graph]):
    graph = new_graph()
    graph.request("optimize", {})
    assert graph.waiting == 1
    update = graph.apply_result()
    assert update is not None
    assert update.counts == {"graph_work_lost": 1}
    assert (graph.waiting, graph.fault) == (0, "this worker discards its jobs")
    with pytest.raises(GraphRequestError, match="this worker discards its jobs"):
        graph.request("optimize", {})
    assert graph.apply_result() is None
