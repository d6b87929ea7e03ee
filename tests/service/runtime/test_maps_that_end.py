"""A map that a command ends has its graph, however short it lasted; see test_commands.Machine."""

from pathlib import Path

import pytest

from service.mapstore.files import load_map, save_map
from tests.service.mapstore.graphs import graph_of
from tests.service.runtime.test_commands import (  # noqa: F401 - fixtures
    Machine,
    free_bytes,
    machine,
)
from tests.service.sinks.test_map_saver import tile

NEVER_NS = 1 << 62


@pytest.mark.parametrize(
    ("verb", "request_of"),
    [("reset_map", {}), ("load_map", {"map": "office"}), ("switch_profile", {"profile": "contour_lm"})],
)
def test_a_map_between_two_resets_that_no_tile_was_handed_over_of_is_saved_with_its_graph(
    machine: Machine,  # noqa: F811
    tmp_path: Path,
    verb: str,
    request_of: dict[str, str],
):
    """Tiles are handed over some times a second: a map that ends before has a graph all the same."""
    save_map(tmp_path / "office", [tile(1)], 1, graph=graph_of(4))
    machine.checkpoints_in(tmp_path / "graphs")
    machine.scan(3)
    assert machine.ask("reset_map")["ok"]
    machine.link.loop._tiles_due_ns = NEVER_NS
    machine.scan(2)
    assert machine.tiles.finest_count == 0
    assert machine.ask(verb, **request_of)["folder_before"] == str(tmp_path / "map_2")
    graph = load_map(tmp_path / "map_2").graph
    assert graph is not None
    assert len(graph) == 5
