"""A result whose map was edited: every export and every file of the result is that of the edited version."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from service.cli import main
from service.errors import InputError, StorageError
from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.mapper.graph.edit.editing import graph_of
from service.mapper.graph.model.pose_graph import to_g2o
from service.mapstore.files import load_map, save_map
from service.offline.export.export import Format, export
from service.offline.maps import edit as map_edit
from service.offline.past.result import open_result
from service.offline.replay import result as replay_result
from service.offline.replay.result import Replay, write_replay
from service.offline.score.trajectory import read_tum
from service.outputs import NO_REASON, MapperOutput
from tests.service.offline.maps.bent_maps import ROUND, BentMap, graph_in

GEO = GeoReference(LocalFrame(48.1, 11.6, 520.0), SE2(12.0, -7.0, 0.5), 0.8, 0.005, 41)
WALL = ("--wall", 1.0, -0.5, 1.0, 0.5)
FILES = (
    "trajectory.tum",
    "graph.g2o",
    "map.pgm",
    "map.yaml",
    "map.png",
    "map.pgw",
    "map.png.aux.xml",
    "geo.json",
    "summary.json",
)


def replay_of(bent: BentMap) -> Replay:
    """A drive along the key frames of the bent map, with a scan in the middle between two of them."""
    ns, poses = bent.graph.stamp_ns, bent.graph.map
    stamps = np.sort(np.concatenate((ns, ns[:-1] + np.diff(ns) // 2))).tolist()
    xy = np.column_stack([np.interp(stamps, ns, poses[:, k]) for k in (0, 1)])
    theta = np.interp(stamps, ns, np.unwrap(poses[:, 2]))
    path = [SE2(x, y, a) for (x, y), a in zip(xy.tolist(), theta.tolist(), strict=True)]
    rest = SE2(), (0.0, 0.0, 0.0), np.zeros((3, 3)), "ok", NO_REASON, 1.0
    outputs = [MapperOutput(stamp_ns, pose, *rest) for stamp_ns, pose in zip(stamps, path, strict=True)]
    summary = {"profile": "corridor", "keyframes": len(bent.graph), "loop_closures": 0, "map_tiles": 1}
    g2o = to_g2o(graph_of(bent.graph))
    lasers = ["front"] * len(outputs)
    return Replay(
        outputs, lasers, {}, frozenset(), path, list(bent.tiles), g2o, summary, geo=GEO, graph=bent.graph
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, bent: BentMap) -> Path:
    folder = tmp_path_factory.mktemp("result")
    write_replay(replay_of(bent), folder)
    return folder


@pytest.fixture
def result(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "result"))


def edit(result: Path, *arguments: object) -> None:
    assert main(["map", "edit", str(result / "map"), *map(str, arguments), "--who", "ada"]) == 0


def join_rounds(result: Path, bent: BentMap) -> None:
    """Two pairs of points that put the second round where it belongs: key frames move by up to 3 m."""
    pairs = [(points.ravel().tolist(), (k, k + ROUND)) for k in (6, 22) for points in bent.common_points(k)]
    map_edit.edit_map(result / "map", "add-pair", map_edit.add_pairs(pairs), "ada", 2_000)


def files_of(result: Path) -> dict[str, bytes]:
    return {name: (result / name).read_bytes() for name in FILES}


@pytest.fixture(scope="module")
def edited(tmp_path_factory, bent: BentMap) -> tuple[Path, Path]:
    """A result as it was, and the same one edited."""
    before, after = (tmp_path_factory.mktemp("edited") / name for name in ("before", "after"))
    for folder in (before, after):
        write_replay(replay_of(bent), folder)
    edit(after, *WALL)
    join_rounds(after, bent)
    return before, after


@pytest.mark.parametrize("to", get_args(Format))
def test_every_export_is_that_of_the_edited_version(edited, tmp_path, to):
    made = []
    for source in edited:
        out = tmp_path / source.name / f"hall.{to}"
        export(source, to, out)
        made.append({path.name: path.read_bytes() for path in out.parent.iterdir()})
    assert made[0] != made[1]


def test_the_trajectory_moves_with_the_key_frames(edited, bent, capsys):
    before, after = edited
    error_m = []
    for source in (before, after):
        read = read_tum(source / "trajectory.tum")
        at = np.isin(read.stamp_ns, bent.graph.stamp_ns)
        error_m.append(float(np.hypot(*(read.pose[at, :2] - bent.truth[:, :2]).T).max()))
    assert error_m[0] > 0.5
    assert error_m[1] < 0.1
    read = read_tum(after / "trajectory.tum")
    np.testing.assert_allclose(
        read.pose[np.isin(read.stamp_ns, bent.graph.stamp_ns)], graph_in(after / "map").map, atol=1e-8
    )
    assert main(["score", str(after), str(before / "trajectory.tum"), "--json"]) == 0  # as it is now
    assert json.loads(capsys.readouterr().out)["ate_m"]["max"] > 0.5
    assert main(["score", str(after / "map"), str(before / "trajectory.tum")]) == InputError.exit_code


def test_an_undo_brings_back_every_file(result, bent):
    before = files_of(result)
    join_rounds(result, bent)
    assert files_of(result) != before
    edit(result, "--undo")
    after = files_of(result)
    for files in before, after:
        del files["map.png"]  # made of the TUM file: a pixel at the edge of a cell may differ
    facts = json.loads(after.pop("summary.json"))
    assert facts == json.loads(before.pop("summary.json")) | {
        "map_version": 3,
        "map_tiles": len(load_map(result / "map").tiles),
    }
    assert after == before


def test_a_session_that_extends_the_map_moves_the_trajectory_as_often_as_it_saves(result, bent):
    """The version that the replay stored is kept, however many follow."""
    moved = replace(bent.graph, map=bent.graph.map + np.array([0.25, 0.0, 0.0]))
    for saved_ns in range(1, 6):
        save_map(result / "map", bent.tiles, saved_ns, graph=moved)
    driven = read_tum(result / "trajectory.tum")
    trajectory = open_result(result).trajectory
    expected = driven.pose + np.array([0.25, 0.0, 0.0])
    np.testing.assert_allclose(trajectory.pose, expected, atol=1e-6)


def test_files_that_cannot_be_rewritten_are_an_error_and_exports_are_right_all_the_same(
    result, tmp_path, monkeypatch
):
    def no_room(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    before = files_of(result)
    monkeypatch.setattr(replay_result, "write_png", no_room)
    with pytest.raises(StorageError, match=r"version 2 of .* is stored; .*No space left on device"):
        map_edit.edit_map(result / "map", "wall", map_edit.wall([1.0, -0.5, 1.0, 0.5]), "ada", 2_000)
    assert files_of(result) == before
    export(result, "pgm", tmp_path / "hall.pgm")
    assert (tmp_path / "hall.pgm").read_bytes() != before["map.pgm"]
