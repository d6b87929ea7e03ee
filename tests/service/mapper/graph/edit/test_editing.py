import pickle

from service.mapper.graph.edit.editing import solved
from service.mapper.graph.loops.loop_back_end import Batch
from tests.service.mapper.graph.loops.rings import RENDERER, fed_ring


def test_solving_a_solved_graph_moves_nothing():
    graph = pickle.loads(fed_ring()[0]).work(Batch([], is_last=True)).saved
    assert len(graph.loop_ends) >= 3
    again = solved(graph, RENDERER)
    assert again.contradicted == 0
    assert again.moved_m.max() < 0.001
