import json
import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from service.errors import ConfigError, InputError
from service.mapper.profiles import mapping_config
from service.mapstore import graph_files
from service.mapstore.annotated import PALETTE, WAY
from service.mapstore.begin_in import begin_in
from service.mapstore.files import load_map, save_map
from service.mapstore.manifest import digest_of
from service.outputs import FREE
from tests.service.mapstore.graphs import graph_of
from tests.service.mapstore.tile_makers import CELL_M, tile

TILES = [tile(0, 0, 3), tile(-1, 2, 4)]


def point_files(folder) -> list[str]:
    return sorted(path.name for path in (folder / "current").glob("points_*"))


def test_a_graph_comes_back_with_its_map(tmp_path):
    graph = graph_of(5)
    save_map(tmp_path, TILES, 1, graph=graph)
    back = load_map(tmp_path).graph
    assert back is not None
    np.testing.assert_array_equal(back.map, graph.map)
    np.testing.assert_allclose(back.xy_base, graph.xy_base, atol=1e-6)


def test_the_picture_shows_each_stretch_of_the_way_and_joins_none(tmp_path):
    xy = [(8.0, 4.0), (8.0, 16.0), (13.0, 16.0), (13.0, 4.0)]
    graph = replace(graph_of(4), map=np.array([(*place, 0.0) for place in xy]), piece=np.array([0, 0, 7, 7]))
    save_map(tmp_path, [tile(0, 0, 1, value=FREE, edge=64)], 1, graph=graph)
    with Image.open(tmp_path / "map.png") as image:
        is_way = (np.asarray(image.convert("RGB")) == PALETTE[WAY]).all(axis=2)
    columns = np.flatnonzero(is_way.sum(axis=0) >= 12.0 / CELL_M)
    assert columns[-1] - columns[0] == 5.0 / CELL_M  # two lines along y
    assert not is_way[:, columns[0] + 1 : columns[-1]].any()


def test_full_files_of_points_are_taken_over_and_not_written_again(tmp_path, monkeypatch):
    monkeypatch.setattr(graph_files, "FRAMES_A_FILE", 4)
    graph = graph_of(10)
    less = replace(
        graph_of(6), xy_base=graph.xy_base[:18], normals=graph.normals[:18], loop_ends=np.array([[0, 5]])
    )
    save_map(tmp_path, TILES, 1, graph=less)
    before = point_files(tmp_path)
    save_map(tmp_path, TILES, 2, graph=graph)
    after = point_files(tmp_path)
    assert len(before) == 2
    assert len(after) == 3
    assert after[0] == before[0]
    assert os.stat(tmp_path / "v000001" / before[0]).st_ino == os.stat(tmp_path / "v000002" / after[0]).st_ino
    assert after[1] != before[1]


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
    assert stored.graph is not None
    assert len(stored.graph) == 5


def test_a_map_of_the_first_format_is_shown_and_not_gone_on_in(tmp_path):
    save_map(tmp_path, TILES, 1)
    path = tmp_path / "v000001" / "manifest.json"
    manifest = json.loads(path.read_text()) | {"format": 1}
    del manifest["sha256"]
    path.write_text(json.dumps(manifest | {"sha256": digest_of(manifest)}))
    assert load_map(tmp_path).graph is None
    with pytest.raises(InputError, match="mapping cannot go on in it"):
        begin_in(tmp_path, mapping_config())


def test_cells_of_another_size_are_refused(tmp_path):
    save_map(tmp_path, TILES, 1, graph=graph_of(3))
    size_m = TILES[0].cell_m
    with pytest.raises(InputError, match=f"cells are of {size_m:g} m, the config has mapping.cell_m 0.2"):
        begin_in(tmp_path, mapping_config({"cell_m": 0.2}))


def test_a_profile_that_cannot_go_on_in_a_map_is_refused(tmp_path):
    save_map(tmp_path, TILES, 1, graph=graph_of(3))
    with pytest.raises(ConfigError, match="imle cannot begin in a stored map"):
        begin_in(tmp_path, mapping_config({"profile": "imle"}))
