import json
import math

import pytest

from service.cli import main
from service.errors import InputError, StorageError
from service.mapstore.files import save_map
from service.offline.maps.work import map_info, map_merge, map_verify
from tests.service.mapstore.tile_makers import graph_of, tile
from tests.service.offline.site.ring_drives import FRAMES, driven, store

TILES = [tile(0, 0, 3), tile(-1, 2, 4)]


def test_a_map_tells_what_it_holds(tmp_path):
    save_map(tmp_path, TILES, 1_700_000_000_000_000_000, {"vehicle": "veh1"}, graph=graph_of(5))
    facts = map_info(tmp_path)
    assert facts["saved"] == "2023-11-14T22:13:20Z"
    assert (facts["vehicle"], facts["keyframes"], facts["loops"], facts["version"]) == ("veh1", 5, 1, 1)
    assert facts["can_be_gone_on_in"] is True
    assert (facts["edit"], facts["refused_loops"], facts["walls"], facts["areas_erased"]) == (None, 0, 0, 0)
    assert facts["disk_mb"] > 0.0


def test_an_older_version_has_figures_of_its_own(tmp_path, capsys):
    save_map(tmp_path, TILES, 1, graph=graph_of(5))
    save_map(tmp_path, TILES, 2, graph=graph_of(60))
    assert map_info(tmp_path, 1)["keyframes"] == 5
    assert map_info(tmp_path)["disk_mb"] > map_info(tmp_path, 1)["disk_mb"]
    assert main(["map", "info", f"{tmp_path}@1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["version"] == 1


def test_every_version_is_verified_and_damage_named(tmp_path):
    save_map(tmp_path, TILES, 1, graph=graph_of(5))
    save_map(tmp_path, TILES, 2, graph=graph_of(6))
    assert map_verify(tmp_path)["versions"] == [1, 2]
    damaged = tmp_path / "v000001" / "graph.npz"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"x")
    with pytest.raises(InputError, match=r"whole: 2; not readable:\n.*v000001/graph.npz"):
        map_verify(tmp_path)


@pytest.mark.parametrize(
    ("graph", "out", "words"),
    [
        (graph_of(5), "a", "is there already"),
        (None, "b", "it cannot be merged"),
        (graph_of(5), "b", "a: all its key frames are in the maps named before it"),
    ],
)
def test_a_merge_overwrites_nothing_and_takes_no_picture_and_no_map_twice(tmp_path, graph, out, words):
    save_map(tmp_path / "a", TILES, 1, graph=graph)
    with pytest.raises(InputError, match=words):
        map_merge([tmp_path / "a", tmp_path / "a"], tmp_path / out, None)
    assert not (tmp_path / "b").exists()


def test_a_merge_that_finds_no_room_leaves_no_folder(tmp_path, monkeypatch):
    def no_room(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for seed, name in enumerate("ab"):
        store(tmp_path / name, driven(name, seed))
    monkeypatch.setattr("service.mapstore.files.write_png", no_room)
    frame = FRAMES["b"]
    same_spot = [0.0, 0.0, 0.0, frame.x_m, frame.y_m, math.degrees(frame.theta_rad)]
    with pytest.raises(StorageError, match=r"cannot save the map to .*both: No space left on device"):
        map_merge([tmp_path / "a", tmp_path / "b"], tmp_path / "both", same_spot)
    assert not (tmp_path / "both").exists()
