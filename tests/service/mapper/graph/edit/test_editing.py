from service.mapper.graph.edit.editing import solved
from tests.service.mapper.graph.loops.rings import RENDERER, saved_of


def test_solving_a_solved_graph_moves_nothing():
    graph = saved_of(1.4)
    assert len(graph.loop_ends) >= 3
    again = solved(graph, RENDERER)
    assert again.contradicted == 0
    assert again.moved_m.max() < 0.001
