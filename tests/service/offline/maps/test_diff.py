"""`corridor map diff`: what changed, counted and painted."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from service.cli import main
from service.errors import InputError
from service.mapstore.difference import COLOURS, WALL_GONE, WALL_NEW, Difference
from service.mapstore.files import save_map
from service.offline.maps.diff import map_diff
from service.outputs import TileUpdate
from tests.service.mapstore.tile_makers import CELL_M, EDGE, graph_of, tile


def changed(one: TileUpdate, *cells: tuple[int, int, int]) -> TileUpdate:
    new = one.cells.copy()
    for row, column, value in cells:
        new[row, column] = value
    return replace(one, cells=new)


FREE = tile(0, 0, 1, value=3)


def test_each_kind_of_change_is_counted():
    after = [changed(FREE, (0, 0, 97), (0, 1, 97), (5, 5, -1), (6, 6, 50)), tile(1, 0, 2, value=3)]
    counts = Difference([FREE, tile(-1, 0, 3, value=97)], after).counts()
    tile_cells = EDGE * EDGE
    assert counts.walls_new == 2
    assert counts.walls_gone == tile_cells
    assert counts.area_new == tile_cells
    assert counts.area_gone == tile_cells + 1
    assert counts.changed == 2 * tile_cells + 4
    with pytest.raises(InputError, match=r"8 x 8 cells of 0.25 m and 8 x 8 cells of 0.5 m"):
        Difference([FREE], [replace(FREE, cell_m=0.25)])


def test_a_map_does_not_differ_from_itself(tmp_path):
    save_map(tmp_path, [FREE, tile(1, 2, 5)], 1, graph=graph_of(5))
    facts = map_diff((tmp_path, None), (tmp_path, 1), None)
    figures = {key: value for key, value in facts.items() if isinstance(value, int | float)}
    assert len(figures) > 10
    assert set(figures.values()) == {0}


def test_poses_loops_and_points_are_compared_by_the_stamps_of_their_key_frames(tmp_path):
    before = graph_of(6)
    moved = before.map.copy()
    moved[2] += (0.3, 0.4, 0.0)
    after = replace(before, map=moved, loop_ends=np.array([[1, 5]]), point_count=np.array([3, 3, 3, 3, 3, 1]))
    after = replace(after, xy_base=after.xy_base[:16], normals=after.normals[:16])
    save_map(tmp_path / "a", [FREE], 1, graph=before)
    save_map(tmp_path / "b", [FREE], 1, graph=after)
    facts = map_diff((tmp_path / "a", None), (tmp_path / "b", None), None)
    assert (facts["keyframes_moved"], facts["loops_new"], facts["loops_gone"]) == (1, 1, 1)
    assert (facts["points_new"], facts["points_gone"]) == (0, 2)
    assert facts["moved"]["max_mm"] == pytest.approx(500.0)
    assert facts["moved"]["max_at_x_m"] == pytest.approx(moved[2, 0], abs=0.006)
    assert (facts["before"], facts["after"]) == (f"{tmp_path / 'a'}@1", f"{tmp_path / 'b'}@1")


def test_maps_that_have_nothing_in_common_are_told(tmp_path):
    walls = [(2, column, 97) for column in range(EDGE)]
    beside = [(3, column, 97) for column in range(EDGE)]
    elsewhere = [(row, 6, 97) for row in range(EDGE)]
    for name, tiles in {
        "a": [changed(FREE, *walls)],
        "b": [changed(FREE, *beside)],
        "c": [changed(FREE, *elsewhere)],
        "d": [tile(9, 9, 1, value=3)],
    }.items():
        save_map(tmp_path / name, tiles, 1)

    def warnings_of(second: str) -> list[str]:
        return map_diff((tmp_path / "a", None), (tmp_path / second, None), None)["warnings"]

    assert warnings_of("b") == []
    (words,) = warnings_of("c")
    assert "both know 16.0 m2; of 8 cells of walls that the second has there, 3 lie within" in words
    assert "both know 0.0 m2; of 0 cells of walls" in warnings_of("d")[0]


def test_versions_of_one_map_are_in_one_frame_whatever_their_walls(tmp_path):
    save_map(tmp_path, [changed(FREE, (2, 3, 97))], 1, graph=graph_of(5))
    save_map(tmp_path, [changed(FREE, (6, 6, 97))], 2, graph=graph_of(5))
    assert map_diff((tmp_path, 1), (tmp_path, 2), None)["warnings"] == []


def test_the_picture_shows_what_is_new_and_what_is_gone(tmp_path):
    before = changed(FREE, (2, 3, 97))
    after = changed(FREE, (4, 6, 97))
    save_map(tmp_path / "m", [before], 1)
    save_map(tmp_path / "m", [after], 2)
    out = tmp_path / "diff.png"
    assert map_diff((tmp_path / "m", 1), (tmp_path / "m", 2), out)["picture"] == str(out)
    pixels = np.array(Image.open(out).convert("RGB"))
    new = np.argwhere((pixels == COLOURS[WALL_NEW]).all(axis=2))
    gone = np.argwhere((pixels == COLOURS[WALL_GONE]).all(axis=2))
    assert len(new) == len(gone) == 1
    assert (new[0] - gone[0]).tolist() == [-2, 3]  # rows of the map go up
    assert CELL_M == 0.5


def test_the_command_prints_a_table_or_json(tmp_path, capsys):
    save_map(tmp_path / "m", [FREE], 1)
    save_map(tmp_path / "m", [changed(FREE, (0, 0, 97))], 2)
    names = [f"{tmp_path / 'm'}@1", str(tmp_path / "m")]
    assert main(["map", "diff", *names]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["new", "gone"]
    assert any(line.split() == ["cells", "of", "walls", "1", "0"] for line in lines)
    assert main(["map", "diff", *names, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["wall_cells_new"] == 1
    assert main(["map", "diff", *names, "--out", str(tmp_path / "diff.jpg")]) == 65
    assert main(["map", "diff", *names, "--out", str(tmp_path / "new" / "diff.png")]) == 0
    assert (tmp_path / "new" / "diff.png").exists()
    (tmp_path / "file").touch()
    assert main(["map", "diff", *names, "--out", str(tmp_path / "file" / "diff.png")]) == 74
