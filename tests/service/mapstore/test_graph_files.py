import numpy as np
import pytest

from service.errors import InputError
from service.mapper.profiles import mapping_config
from service.mapstore.begin_in import begin_in
from service.mapstore.files import load_map, save_map
from tests.service.mapstore.tile_makers import graph_of, tile

TILES = [tile(0, 0, 3), tile(-1, 2, 4)]


def test_a_graph_comes_back_with_its_map(tmp_path):
    graph = graph_of(5)
    save_map(tmp_path, TILES, 1, graph=graph)
    back = load_map(tmp_path).graph
    np.testing.assert_array_equal(back.map, graph.map)
    np.testing.assert_allclose(back.xy_base, graph.xy_base, atol=1e-6)


@pytest.mark.parametrize("name", ["graph.npz", "points"])
def test_damage_is_named_and_the_version_before_is_read(tmp_path, name):
    save_map(tmp_path, TILES, 1, graph=graph_of(5))
    save_map(tmp_path, TILES, 2, graph=graph_of(6))
    damaged = next(path for path in (tmp_path / "current").iterdir() if path.name.startswith(name))
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 0xFF
    damaged.write_bytes(content)
    stored = load_map(tmp_path)
    assert stored.number == 1
    assert damaged.name in stored.problems[0]
    assert len(stored.graph) == 5


def test_a_map_without_a_graph_is_shown_and_not_gone_on_in(tmp_path):
    save_map(tmp_path, TILES, 1)
    assert load_map(tmp_path).graph is None
    with pytest.raises(InputError, match="mapping cannot go on in it"):
        begin_in(tmp_path, mapping_config())


def test_cells_of_another_size_are_refused(tmp_path):
    save_map(tmp_path, TILES, 1, graph=graph_of(3))
    size_m = TILES[0].cell_m
    with pytest.raises(InputError, match=f"cells are of {size_m:g} m, the config has mapping.cell_m 0.2"):
        begin_in(tmp_path, mapping_config({"cell_m": 0.2}))
