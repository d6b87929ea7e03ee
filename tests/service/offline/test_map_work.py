import pytest

from service.errors import InputError
from service.mapstore.files import save_map
from service.offline.map_work import map_info, map_merge, map_verify
from tests.service.mapstore.test_graph_files import graph_of
from tests.service.mapstore.tile_makers import tile

TILES = [tile(0, 0, 3), tile(-1, 2, 4)]


def test_a_map_tells_what_it_holds(tmp_path):
    save_map(tmp_path, TILES, 1_700_000_000_000_000_000, {"vehicle": "veh1"}, graph=graph_of(5))
    told = map_info(tmp_path)
    assert told["saved"] == "2023-11-14T22:13:20Z"
    assert (told["vehicle"], told["keyframes"], told["loops"], told["version"]) == ("veh1", 5, 1, 1)
    assert told["can_be_gone_on_in"] is True
    assert told["disk_mb"] > 0.0


def test_a_map_without_a_graph_says_so(tmp_path):
    save_map(tmp_path, TILES, 1)
    told = map_info(tmp_path)
    assert told["can_be_gone_on_in"] is False
    assert "keyframes" not in told


def test_every_version_is_verified_and_damage_named(tmp_path):
    save_map(tmp_path, TILES, 1, graph=graph_of(5))
    save_map(tmp_path, TILES, 2, graph=graph_of(6))
    assert map_verify(tmp_path)["versions"] == [1, 2]
    damaged = tmp_path / "v000001" / "graph.npz"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    with pytest.raises(InputError, match=r"versions \[2\] are whole; damaged:\n.*v000001/graph.npz"):
        map_verify(tmp_path)


def test_what_is_no_map_is_no_map(tmp_path):
    with pytest.raises(InputError, match="no stored map"):
        map_verify(tmp_path)


def test_a_merge_overwrites_nothing(tmp_path):
    save_map(tmp_path / "a", TILES, 1, graph=graph_of(5))
    with pytest.raises(InputError, match="is there already"):
        map_merge([tmp_path / "a", tmp_path / "a"], tmp_path / "a", None)


def test_a_picture_cannot_be_merged(tmp_path):
    save_map(tmp_path / "a", TILES, 1)
    with pytest.raises(InputError, match="it cannot be merged"):
        map_merge([tmp_path / "a", tmp_path / "a"], tmp_path / "b", None)
    assert not (tmp_path / "b").exists()
