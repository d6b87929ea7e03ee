"""`corridor map loops`: what holds a map together, what was not believed, and why."""

import json
import pickle

import numpy as np
import pytest

from service.cli import main
from service.mapper.graph.loops.loop_back_end import Batch
from service.mapper.graph.model.loops import Loop
from service.mapper.saved_graph import SavedGraph
from service.mapstore.files import save_map
from service.offline.maps.loops import map_loops
from tests.service.mapper.graph.loops.rings import fed_ring
from tests.service.mapstore.tile_makers import tile

TILES = [tile(0, 0, 1)]


@pytest.fixture(scope="module")
def graph() -> SavedGraph:
    """A ring with a loop among the others that the rest contradicts."""
    back_end = pickle.loads(fed_ring()[0])
    covariance = np.diag([1e-4, 1e-4, 1e-5])
    back_end.loops.accepted.append(Loop(10, 80, np.array([0.0, 0.3, 0.0]), covariance, 0.9, 300, 0.01))
    return back_end.work(Batch([], is_last=True)).saved


def test_the_loops_of_a_map_are_reported_with_place_and_evidence(tmp_path, graph):
    save_map(tmp_path, TILES, 1, graph=graph)
    facts = map_loops(tmp_path)
    assert [loop["loop"] for loop in facts["accepted"]] == list(range(len(graph.loop_ends)))
    for loop in facts["accepted"]:
        _, to = loop["keyframes"]
        assert (loop["x_m"], loop["y_m"]) == pytest.approx(graph.map[to, :2], abs=0.006)
        assert loop["points"] > 100
        assert loop["on_map"] > 0.5
        assert loop["in_free"] < 0.12
        assert loop["off_mm"] < 60.0
        assert loop["back_at_s"] - loop["from_s"] > 10.0
    refused = [tuple(ends) for ends in graph.refused.ends.tolist()]
    assert len(refused) == len({*refused} - {*map(tuple, graph.loop_ends.tolist())})  # none twice


def test_the_table_names_each_loop_and_json_is_json(tmp_path, graph, capsys):
    save_map(tmp_path, TILES, 1, graph=graph)
    assert main(["map", "loops", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1 + len(graph.loop_ends) + len(graph.refused.ends)
    assert lines[0].startswith("loop")
    assert main(["map", "loops", f"{tmp_path}@1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["version"] == 1
    assert main(["map", "loops", f"{tmp_path}@7"]) == 65
    save_map(tmp_path / "picture", TILES, 1)
    assert main(["map", "loops", str(tmp_path / "picture")]) == 65
    assert "it has no loops" in capsys.readouterr().err
