"""Versions that a person made: kept, listed, taken back one by one."""

import pytest

from service.errors import InputError
from service.mapstore.edits import Edit, undone_by
from service.mapstore.files import load_map, restore_version, save_map, versions_of
from tests.service.mapstore.tile_makers import graph_of, same, tile


def edited(folder, value: int, before: int) -> None:
    edit = Edit("ada", "erase", "erased 4 m2", before)
    save_map(folder, [tile(0, 0, value, value=value)], value, {"vehicle": "veh1"}, edit=edit)


def undo(folder) -> int:
    versions, current, _ = versions_of(folder)
    _, back_to = undone_by(versions, current)
    return restore_version(folder, back_to, 99, Edit("ada", "undo", "", current, back_to))


def test_what_is_restored_is_all_of_the_version(tmp_path):
    tiles = [tile(0, 0, 3), tile(-1, 2, 4)]
    save_map(tmp_path, tiles, 1, {"vehicle": "veh1"}, graph=graph_of(5))
    edited(tmp_path, 2, 1)
    undo(tmp_path)
    stored = load_map(tmp_path)
    assert stored.about == {"vehicle": "veh1"}
    assert all(same(a, b) for a, b in zip(stored.tiles, tiles, strict=True))
    assert len(stored.graph) == 5


def test_a_damaged_version_is_not_restored(tmp_path):
    save_map(tmp_path, [tile(0, 0, 1)], 1)
    edited(tmp_path, 2, 1)
    (tmp_path / "v000001" / "tiles.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"v000001/tiles\.npz: 0 bytes, not the \d+ saved"):
        undo(tmp_path)
    assert versions_of(tmp_path)[1] == 2
    with pytest.raises(InputError, match="no version 9; there are 1, 2"):
        restore_version(tmp_path, 9, 1, Edit("ada", "undo", "", 2, 9))
