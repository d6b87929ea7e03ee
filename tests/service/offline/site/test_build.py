"""One map of several drives: drives round a ring of corridors, each in a map frame of its own."""

import errno
import json
import math
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.cli import main
from service.errors import InputError, StorageError
from service.geometry import poses as se2
from service.geometry.geo_reference import GeoReference, LocalFrame
from service.geometry.se2 import SE2
from service.mapper.graph.edit.editing import only
from service.mapstore.files import load_map
from service.offline.cluster.engines import Ended, in_turn
from service.offline.cluster.tasks import AnyTask
from service.offline.site import growth, kept
from service.offline.site.manifest import SITE_FILE
from service.offline.site.tasks import Find, FindLoops
from tests.service.mapper.graph.loops import rings
from tests.service.offline.site.ring_drives import (
    COUNT,
    FIRST,
    FRAMES,
    HOUR_NS,
    build,
    driven,
    names_in,
    store,
)

ORIGIN = LocalFrame(48.1, 11.5, 500.0)


class Counting:
    """An engine that keeps the tasks it did, and ends them in the reverse of their order."""

    def __init__(self) -> None:
        self.done: list[AnyTask] = []

    def __call__(self, tasks: Sequence[AnyTask]) -> Ended:
        self.done += tasks
        yield from reversed(list(in_turn(tasks)))


@pytest.fixture(scope="module")
def drives(few_beams_and_questions: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stored map of each drive; `elsewhere` of another building."""
    folder = tmp_path_factory.mktemp("drives")
    for seed, name in enumerate(FRAMES):
        store(folder / name, driven(name, seed))
    with pytest.MonkeyPatch.context() as patch:
        boxes = ((-1.0, -1.0, 15.0, 10.0), (0.6, 0.6, 6.0, 8.4), (8.0, 0.6, 13.4, 8.4))
        patch.setattr(rings, "RING", [side for box in boxes for side in rings.rectangle(*box)])
        store(folder / "elsewhere", driven("a", 7, begin_ns=9 * HOUR_NS))
    return folder


def true_pose(k: int) -> SE2:
    return rings.round_the_ring(k * rings.STEP_M)


def errors_m(out: Path, names: Sequence[str]) -> np.ndarray:
    """Of all key frames, in the frame of the first drive, which is that of the truth."""
    graph = load_map(out).graph
    numbers = [k for name in names for k in range(FIRST[name], FIRST[name] + COUNT)]
    expected = np.array([(pose.x_m, pose.y_m) for pose in map(true_pose, numbers)])
    return np.hypot(*(graph.map[:, :2] - expected).T)


@pytest.fixture(scope="module")
def three(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("site") / "map"
    return out, build([drives / name for name in ("a", "b", "c", "elsewhere")], out)


def test_all_drives_of_a_place_lie_in_one_frame(three):
    out, report = three
    assert names_in(report) == ["a", "b", "c"]
    off_m = errors_m(out, ("a", "b", "c"))
    assert math.sqrt((off_m**2).mean()) < 0.02
    assert all(one["loops"] >= 3 and one["residual_mm"] < 100.0 for one in report["sessions"])
    assert load_map(out).graph.checked() is not None


def test_a_drive_of_another_place_is_left_out_by_its_name(three):
    _, report = three
    assert list(report["left_out"]) == ["elsewhere"]
    assert "overlap too little" in report["left_out"]["elsewhere"]


def test_a_drive_that_was_left_out_is_named_until_it_is_forgotten(three, tmp_path, capsys):
    out = Path(shutil.copytree(three[0], tmp_path / "map", symlinks=True))
    before = files_in(out)
    assert main(["site", "build", "--out", str(out)]) == 64
    assert main(["site", "build", "--out", str(out), "--forget", "b"]) == 64
    assert "--forget b: no such session among those left out, which are elsewhere" in capsys.readouterr().err
    assert list(json.loads((out / SITE_FILE).read_text())["left_out"]) == ["elsewhere"]
    assert main(["site", "build", "--out", str(out), "--forget", "elsewhere", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["left_out"], report["added"], names_in(report)) == ({}, 0, ["a", "b", "c"])
    assert json.loads((out / SITE_FILE).read_text())["left_out"] == {}
    assert files_in(out) == before


def test_the_order_in_which_tasks_end_does_not_change_a_byte(two, drives, tmp_path):
    again = tmp_path / "map"
    build([drives / name for name in ("a", "b")], again, Counting())
    assert files_in(again) == files_in(two)


def test_of_many_drives_as_many_are_searched_at_once_as_the_site_has(drives, tmp_path, monkeypatch):
    for name in ("FEW", "FIRST_SEARCHED"):
        monkeypatch.setattr(growth, name, 1)
    engine = Counting()
    report = build([drives / name for name in ("a", "elsewhere", "b", "c")], tmp_path / "map", engine)
    second, third = ("session 1 of the site", "session 2 of the site")
    names = [task.name for task in engine.done]
    assert names == ["elsewhere", "b", second, "elsewhere", "c", third, "elsewhere"]
    assert (names_in(report), list(report["left_out"])) == (["a", "b", "c"], ["elsewhere"])
    assert math.sqrt((errors_m(tmp_path / "map", names_in(report)) ** 2).mean()) < 0.02


def test_a_drive_that_a_part_of_the_site_refuses_is_searched_in_all_of_it(drives, tmp_path, monkeypatch):
    """As one that was found at a place which looks like another one."""
    log_odds = chain([-1.0, growth.MIN_LOG_ODDS], repeat(-1.0))  # of a, of b, and of all from then on
    monkeypatch.setattr(growth, "log_odds_elsewhere", lambda **_: next(log_odds))
    report = build([drives / name for name in ("a", "b", "c")], tmp_path / "map")
    assert (names_in(report), report["left_out"]) == (["a", "c", "b"], {})


def files_in(folder: Path) -> dict[str, bytes]:
    """All but the list of who is in it, and who is not."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != SITE_FILE]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(scope="module")
def two(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site") / "map"
    build([drives / "a", drives / "b"], out)
    return out


@pytest.fixture
def grown(two: Path, tmp_path: Path) -> Path:
    """A copy of the site of two drives."""
    return Path(shutil.copytree(two, tmp_path / "map", symlinks=True))


@pytest.fixture(scope="module")
def with_c(two: Path, drives: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the site of two drives, to which a third one was added."""
    out = Path(shutil.copytree(two, tmp_path_factory.mktemp("site") / "map", symlinks=True))
    build([drives / "c"], out)
    return out


def test_a_new_drive_is_added_without_doing_the_others_again(grown, drives):
    engine = Counting()
    report = build([drives], grown, engine)
    assert sorted(names_in(report)) == ["a", "b", "c", "d"]
    assert (report["added"], report["version"]) == (2, 2)
    assert {task.name for task in engine.done if isinstance(task, Find)} == {"c", "d", "elsewhere"}
    searched = {task.name for task in engine.done if isinstance(task, FindLoops)}
    assert searched == {"session 2 of the site", "session 3 of the site"}
    off_m = errors_m(grown, names_in(report))
    assert math.sqrt((off_m**2).mean()) < 0.02
    idle = Counting()
    again = build([drives], grown, idle)
    assert (idle.done, again["added"], again["version"]) == ([], 0, 2)
    assert list(again["left_out"]) == ["elsewhere"]


def test_what_was_drawn_by_hand_outlives_the_next_build_and_a_map_that_lost_key_frames_is_refused(
    grown, drives
):
    assert main(["map", "edit", str(grown), "--wall", "2", "-0.5", "2", "0.5"]) == 0
    assert main(["map", "edit", str(grown), "--cut", "1", "2", "--bridge"]) == 0
    with pytest.raises(InputError, match="cut, remapped or extended"):
        build([drives / "c"], grown)
    assert main(["map", "edit", str(grown), "--undo"]) == 0
    assert names_in(build([drives / "c"], grown)) == ["a", "b", "c"]
    assert len(load_map(grown).graph.by_hand.kind) == 1


def test_a_damaged_file_of_a_site_is_made_again_or_refused(grown, drives):
    (grown / "kept" / "a.npz").write_text("damaged")
    assert names_in(build([drives / "c"], grown)) == ["a", "b", "c"]
    (grown / "v000002" / "graph.npz").write_text("damaged")
    with pytest.raises(InputError, match="remove the folder of that version to continue from version 1"):
        build([drives / "d"], grown)
    shutil.rmtree(grown / "v000002")
    assert names_in(build([drives / "c"], grown)) == ["a", "b", "c"]


def test_a_map_that_is_no_site_is_not_built_upon(drives, tmp_path):
    shutil.copytree(drives / "a", tmp_path / "map", symlinks=True)
    with pytest.raises(InputError, match="no site build made"):
        build([drives / "b"], tmp_path / "map")


def test_one_drive_counts_once(drives, tmp_path):
    shutil.copytree(drives / "a", tmp_path / "copy_of_a", symlinks=True)
    named = [drives / "a", drives / "a" / ".." / "a", tmp_path / "copy_of_a"]
    report = build(named, tmp_path / "map")
    assert names_in(report) == ["a"]
    assert list(report["left_out"]) == ["copy_of_a"]
    assert report["left_out"]["copy_of_a"].startswith("it is the drive of a, ")


def test_another_drive_of_a_name_that_is_taken_is_numbered(grown, drives, tmp_path):
    for name, other in (("a", "c"), ("b", "b")):
        shutil.copytree(drives / other, tmp_path / "later" / name, symlinks=True)
    report = build([tmp_path / "later"], grown)
    assert names_in(report) == ["a", "b", "a_2"]
    assert build([tmp_path / "later"], grown)["added"] == 0


def test_a_drive_that_was_mapped_again_is_left_out(grown, drives, tmp_path):
    again = Path(shutil.copytree(drives / "a", tmp_path / "again" / "a", symlinks=True))
    assert main(["map", "edit", str(again), "--wall", "2", "-0.5", "2", "0.5"]) == 0
    report = build([again], grown)
    assert names_in(report) == ["a", "b"]
    assert report["left_out"]["a_2"].startswith("it is the drive of a, by the stamps of its key frames; if ")


@pytest.mark.parametrize("step", ["write_kept", "save_map", "write_changed_places"])
def test_a_build_that_was_killed_is_continued_by_the_next_one(step, grown, with_c, drives, monkeypatch):
    (grown / ".build" / "killed").mkdir(parents=True)
    with monkeypatch.context() as patch:
        patch.setattr(f"service.offline.site.build.{step}", killed)
        with pytest.raises(KeyboardInterrupt):
            build([drives / "c"], grown)
    assert len(load_map(grown).graph) >= 2 * COUNT
    assert names_in(build([drives / "c"], grown)) == ["a", "b", "c"]
    built, as_expected = files_in(grown), files_in(with_c)
    assert built.keys() == as_expected.keys()
    assert [name for name in built if built[name] != as_expected[name]] == []


def test_what_members_saw_is_written_again_only_where_they_moved(grown, drives, monkeypatch):
    (grown / "kept" / "b.npz").write_text("damaged")
    files = [grown / "kept" / f"{name}.npz" for name in ("a", "b", "c")]
    before = written(files[0])
    for name in ("SAME_M", "SAME_RAD"):
        monkeypatch.setattr(kept, name, 1.0)
    assert names_in(build([drives / "c"], grown)) == ["a", "b", "c"]
    assert written(files[0]) == before
    assert all(kept.read_kept(grown, file.stem) is not None for file in files)
    monkeypatch.setattr(kept, "SAME_M", 0.0)
    assert names_in(build([drives / "d"], grown)) == ["a", "b", "c", "d"]
    assert written(files[0]) != before


def written(path: Path) -> tuple[int, int]:
    return path.stat().st_ino, path.stat().st_mtime_ns


def test_a_build_leaves_nothing_behind_but_the_map(grown, drives, tmp_path, monkeypatch):
    for step in ("growth._Round.find", "build.save_map"):
        with monkeypatch.context() as patch:
            patch.setattr(f"service.offline.site.{step}", killed)
            for out in (tmp_path / "new", grown):
                with pytest.raises(KeyboardInterrupt):
                    build([drives / "b", drives / "c"], out)
                assert not (out / ".build").exists()
        assert (tmp_path / "new").exists() == (step == "build.save_map")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="stored no map"):
        build([parked(tmp_path)], tmp_path / "empty")
    assert list((tmp_path / "empty").iterdir()) == []
    build([drives / "c"], grown)
    assert not (grown / ".build").exists()


def test_a_build_that_is_interrupted_removes_its_folder_and_no_other_ones(grown, drives, monkeypatch):
    cleanups: list[Any] = []
    monkeypatch.setattr("service.offline.site.build.before_ending", cleanups.append)

    def interrupted(tasks: Sequence[AnyTask]) -> Ended:
        assert (grown / ".build").exists()
        cleanups[-1]()
        assert not (grown / ".build").exists()
        raise KeyboardInterrupt
        yield

    with pytest.raises(KeyboardInterrupt):
        build([drives / "c"], grown, interrupted)
    (grown / ".build").mkdir()
    cleanups[-1]()
    assert (grown / ".build").exists()


def parked(folder: Path) -> Path:
    """A result without a map."""
    (folder / "parked").mkdir()
    (folder / "parked" / "summary.json").write_text("{}")
    return folder / "parked"


def killed(*_: Any) -> None:
    raise KeyboardInterrupt


def test_a_full_disk_is_reported_and_the_map_stays(grown, drives, monkeypatch):
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    before = files_in(grown)
    for step in ("growth.keep_graph", "paths.write_tum", "kept.write_arrays"):
        with monkeypatch.context() as patch:
            patch.setattr(f"service.offline.site.{step}", full)
            words = re.escape(f"to {grown}: No space left on device; the version before is untouched")
            if step.startswith("paths"):
                words = f"cannot write {grown}/paths/.*: No space"
            if step.startswith("kept"):
                words = f"cannot write {grown}/kept/.*: No space"
            with pytest.raises(StorageError, match=words):
                build([drives / "c"], grown)
        assert names_in(build([drives / "a"], grown)) == ["a", "b"]
    assert before.items() >= {name: one for name, one in files_in(grown).items() if "v00" in name}.items()


def test_two_builds_of_one_site_at_a_time_are_refused(grown, drives):
    def other(tasks: Sequence[AnyTask]) -> Ended:
        with pytest.raises(StorageError, match="another process is writing this map"):
            build([drives / "c"], grown)
        yield from in_turn(tasks)

    assert names_in(build([drives / "c"], grown, other)) == ["a", "b", "c"]


def test_an_edit_during_a_build_is_not_lost(grown, drives):
    def edited(tasks: Sequence[AnyTask]) -> Ended:  # to look for the drive, and for loops
        assert main(["map", "edit", str(grown), "--wall", "2", "-0.5", "2", "0.5"]) == 0
        yield from in_turn(tasks)

    with pytest.raises(InputError, match="changed during the build"):
        build([drives / "c"], grown, edited)
    assert len(load_map(grown).graph.by_hand.kind) == 2


def test_fixes_place_drives_that_do_not_overlap(drives, tmp_path):
    graph = load_map(drives / "a").graph
    half, turn = COUNT // 4, FRAMES["b"]
    for name, rows, frame in (("first", slice(0, half), SE2()), ("second", slice(-half, None), turn)):
        is_kept = np.zeros(COUNT, np.bool_)
        is_kept[rows] = True
        part = only(graph, is_kept)
        moved = se2.compose(np.array([frame.x_m, frame.y_m, frame.theta_rad]), part.map)
        pose_enu = SE2(100.0, 50.0, 0.3) @ frame.inverse()
        store(tmp_path / name, replace(part, map=moved), GeoReference(ORIGIN, pose_enu, 0.02, 0.001, 40))
    report = build([tmp_path / "first", tmp_path / "second"], tmp_path / "map")
    assert names_in(report) == ["first", "second"]
    stored = load_map(tmp_path / "map")
    true = np.concatenate((graph.map[:half], graph.map[-half:]))
    assert np.hypot(*(stored.graph.map - true)[:, :2].T).max() < 0.02
    assert stored.geo.pose_enu_map.x_m == pytest.approx(100.0, abs=0.02)
    assert stored.geo.fixes == 80


def test_the_command_tells_who_is_in_and_who_is_not(three, drives, capsys):
    out, _ = three
    assert main(["site", "build", str(drives / "b"), "--out", str(out)]) == 0
    table, summary = capsys.readouterr().out.rstrip().rsplit("\n", 1)
    assert "left out: elsewhere: " in table
    assert summary.endswith("3 sessions of the site, 0 of them new; 1 left out: elsewhere")


def test_a_recording_that_cannot_be_read_keeps_no_other_back_and_gives_the_exit_code(
    drives, tmp_path, capsys
):
    bad = tmp_path / "bad.mcap"
    bad.write_text("no recording")
    command = ["site", "build", str(bad), str(drives / "a"), "--out", str(tmp_path / "site")]
    assert main([*command, "--json"]) == InputError.exit_code
    report = json.loads(capsys.readouterr().out)
    assert (names_in(report), report["failed"]) == (["a"], {"bad": InputError.exit_code})
    assert "bad.mcap is no recording" in report["left_out"]["bad"]
    assert main(command) == InputError.exit_code
    capsys.readouterr()
    assert main(["site", "build", str(drives / "a"), "--out", str(tmp_path / "site"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["left_out"] == {}


def test_what_a_folder_of_results_has_besides_is_named(drives, tmp_path):
    (tmp_path / "a").symlink_to(drives / "a")
    (tmp_path / "later.mcap").touch()
    parked(tmp_path)
    (tmp_path / "broken_off").mkdir()
    shutil.copytree(drives / "a", tmp_path / "mixed" / "map", symlinks=True)
    (tmp_path / "mixed" / "b").symlink_to(drives / "b")
    build([drives / "a"], tmp_path / "site")
    report = build([tmp_path], tmp_path / "site")
    assert (names_in(report), report["added"]) == (["a"], 0)
    assert "stored no map" in report["left_out"]["parked"]
    assert "1 recording passed over, beside 3 results" in report["warnings"][0]
    assert "broken_off passed over, beside 3 results: neither map nor" in report["warnings"][1]
    mixed = build([tmp_path / "mixed"], tmp_path / "site")
    assert "mixed: a result, of which b are passed over; name each" in mixed["warnings"][0]
