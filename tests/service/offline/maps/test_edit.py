"""What `corridor map edit` does to a stored map: each change on disk, listed, and taken back."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from service.cli import main
from service.errors import StorageError, UsageError
from service.mapper.components import SavedGraph
from service.mapper.profiles import mapping_config
from service.mapstore.begin_in import begin_in
from service.mapstore.files import load_map, save_map
from service.mapstore.in_use import InUse
from service.offline.maps.edit import edit_map, erase, stamp_of, undo, wall
from service.offline.maps.work import map_log
from service.outputs import TileUpdate
from tests.service.mapper.graph.loops.rings import CABINET, saved_of
from tests.service.offline.maps.bent_maps import graph_in, tiles_of

SQUARE = [0.5, 0.5, 1.5, 0.5, 1.5, 1.5, 0.5, 1.5]


def cell(tiles: list[TileUpdate], x_m: float, y_m: float) -> int:
    edge, cell_m = len(tiles[0].cells), tiles[0].cell_m
    column, row = int(np.floor(x_m / cell_m)), int(np.floor(y_m / cell_m))
    at = next(t for t in tiles if (t.ix, t.iy) == (column // edge, row // edge))
    return int(at.cells[row % edge, column % edge])


@pytest.fixture(scope="module")
def graph() -> SavedGraph:
    return saved_of(1.2)


@pytest.fixture(scope="module")
def stored_ring(tmp_path_factory, graph):
    """A stored map of a ring of corridors."""
    folder = tmp_path_factory.mktemp("stored") / "ring"
    save_map(folder, tiles_of(graph), 1_000, {"vehicle": "veh1"}, graph=graph)
    return folder


@pytest.fixture
def ring(tmp_path, stored_ring):
    """A copy of it."""
    return Path(shutil.copytree(stored_ring, tmp_path / "ring", symlinks=True))


def edit(folder, *arguments: object, code: int = 0) -> None:
    assert main(["map", "edit", str(folder), *map(str, arguments), "--who", "ada"]) == code


def test_an_erased_area_is_gone_and_all_else_is_as_it_was(ring, graph):
    before = load_map(ring)
    assert cell(before.tiles, 4.3, -0.7) > 65
    edit(ring, "--erase", *CABINET.ravel(), "--unknown")
    after = load_map(ring)
    assert (after.number, after.edit.who, after.edit.what, after.edit.before) == (2, "ada", "erase", 1)
    assert after.graph.point_count.sum() < graph.point_count.sum()
    by_key = {(t.ix, t.iy): t for t in after.tiles}
    changed = 0
    for old in before.tiles:
        new = by_key[old.ix, old.iy]
        differs = np.argwhere(new.cells != old.cells)
        changed += len(differs)
        xy = (differs[:, ::-1] + (old.ix * 64, old.iy * 64) + 0.5) * 0.05
        assert ((xy > CABINET.min(axis=0)) & (xy < CABINET.max(axis=0))).all()
        assert (new.cells[differs[:, 0], differs[:, 1]] == -1).all()
    assert changed > 100
    assert cell(after.tiles, 4.3, -0.7) == -1
    edit(ring, "--optimize")  # rendered again, it stays erased
    assert cell(load_map(ring).tiles, 4.3, -0.7) == -1
    np.testing.assert_allclose(graph_in(ring).map, after.graph.map, atol=1e-3)  # it was solved before
    assert cell(load_map(ring).tiles, 2.0, -1.0) > 65 or cell(load_map(ring).tiles, 2.0, -1.04) > 65


def test_a_wall_is_on_the_map_for_other_programs_and_for_sessions(ring, capsys):
    edit(ring, "--wall", 6.0, -0.5, 6.0, 0.5)
    assert "changing the map ..." in capsys.readouterr().err
    stored = load_map(ring)
    assert cell(stored.tiles, 6.0, 0.0) == 97
    edit(ring, "--optimize")
    assert cell(load_map(ring).tiles, 6.0, 0.0) == 97
    begun = begin_in(ring, mapping_config())
    assert len(begun.shown.wall_cells) >= 20
    edit(ring, "--erase", 5.5, -1, 6.5, -1, 6.5, 1, 5.5, 1)
    assert cell(load_map(ring).tiles, 6.0, 0.0) < 10
    assert len(begin_in(ring, mapping_config()).shown.wall_cells) == 0


@pytest.mark.parametrize(
    ("text", "begin_ns", "expected"),
    [
        ("2023-11-14T22:13:20.5Z", 0, 1_700_000_000_500_000_000),
        ("2023-11-14T23:13:20+01:00", 0, 1_700_000_000_000_000_000),
        ("1.5", 7, 1_500_000_007),
    ],
)
def test_a_time_is_seconds_of_the_drive_or_utc(text, begin_ns, expected):
    assert stamp_of(text, begin_ns) == expected
    with pytest.raises(UsageError, match="noon: expected seconds"):
        stamp_of("noon", 0)


def test_the_log_is_a_table_and_json(ring, capsys):
    edit(ring, "--wall", 0, 0, 1, 0)
    capsys.readouterr()
    assert main(["map", "log", str(ring)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["version", "when", "who", "what", "words"]
    assert lines[2].startswith("2*")
    assert "drew a wall of 1.00 m about (0.50, 0.00) m" in lines[2]
    assert main(["map", "log", str(ring), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["versions"][1]["made_in"] == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--erase", 0, 0, 1, 1], "expected X Y of 3 points or more"),
        (["--erase", 0, 0, 1, 1, 2, 2], "enclose no area"),
        (["--erase", 0, 0, 1, 0, "nan", 1], "expected X Y of 3 points"),
        (["--wall", 0, 0, 1], "expected X Y of 2 points or more"),
        (["--wall", 1, 2, 1, 2, 1, 2], "all 3 points of the wall are (1.00, 2.00) m; it has no length"),
        (["--wall", 0, 0, 1, 1, "--free"], "--free goes with --erase"),
        (["--optimize", "--to", 1], "--to goes with --undo"),
    ],
)
def test_what_is_no_change_is_refused(picture, capsys, arguments, words):
    edit(picture, *arguments, code=64)
    assert words in capsys.readouterr().err
    assert map_log(picture)["current"] == 1


def test_nothing_is_changed_under_a_session_that_goes_on_in_the_map(picture):
    with InUse(picture, "a session of veh1"):
        with pytest.raises(StorageError, match="a session of veh1 uses this map"):
            edit_map(picture, "erase", erase(SQUARE, "unknown"), "ada", 1)
        with pytest.raises(StorageError, match="stop it first"):
            undo(picture, 1, "ada", 1)
    assert map_log(picture)["current"] == 1
    edit_map(picture, "wall", wall([0, 0, 1, 0]), "ada", 1)
