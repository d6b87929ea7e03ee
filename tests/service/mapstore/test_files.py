import json
import os
import shutil
from pathlib import Path

import pytest

from service.errors import InputError, StorageError
from service.mapstore import files
from service.mapstore.files import (
    KEEP_VERSIONS,
    check_versions,
    has_version,
    keep_version,
    load_map,
    save_map,
)
from service.mapstore.geo_file import read_geo
from service.mapstore.manifest import FORMAT, digest_of
from service.mapstore.ros_map import read_ros_map
from tests.service.mapstore.tile_makers import GEO, graph_of, same, tile


class Killed(BaseException):
    """The process is gone."""


TILES = [tile(0, 0, 3), tile(-1, 2, 4), tile(0, 0, 5, level=1)]


def test_a_map_comes_back_as_it_was_saved(tmp_path):
    assert save_map(tmp_path / "maps" / "depot", TILES, 1_700_000_000_123_456_789, {"vehicle": "veh1"}) == 1
    stored = load_map(tmp_path / "maps" / "depot")
    assert (stored.number, stored.about, stored.problems) == (1, {"vehicle": "veh1"}, [])
    assert stored.saved_ns == 1_700_000_000_123_456_789
    assert all(same(a, b) for a, b in zip(stored.tiles, TILES, strict=True))
    assert not stored.tiles[0].cells.flags.writeable


def test_a_version_that_a_session_began_in_is_kept(tmp_path):
    save_map(tmp_path, [tile(0, 0, 1)], 1)
    save_map(tmp_path, [tile(0, 0, 2)], 2)
    keep_version(tmp_path, 2, "a session of veh1 began in it")
    digest = load_map(tmp_path, 2).digest
    for version in range(3, 8):
        save_map(tmp_path, [tile(0, 0, version)], version)
    assert check_versions(tmp_path) == ([2, 5, 6, 7], [])
    assert has_version(tmp_path, 2, digest)
    assert not has_version(tmp_path, 5, digest)
    assert not has_version(tmp_path, 1, digest)


@pytest.mark.parametrize("name", ["tiles.npz", "map.pgm", "map.yaml", "map.png", "geo.json", "manifest.json"])
@pytest.mark.parametrize("damage", ["flipped", "cut", "gone"])
def test_a_damaged_version_is_passed_over_and_named(tmp_path, name, damage):
    for version in (1, 2):
        save_map(tmp_path, [tile(0, 0, version)], version, geo=GEO)
    path = tmp_path / "v000002" / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x10
    match damage:
        case "flipped":
            path.write_bytes(content)
        case "cut":
            path.write_bytes(content[: len(content) // 2])
        case "gone":
            path.unlink()
    stored = load_map(tmp_path)
    assert (stored.number, stored.saved_ns) == (1, 1)
    assert len(stored.problems) == 1
    assert str(path) in stored.problems[0]


@pytest.mark.parametrize("number", [FORMAT - 1, FORMAT + 1])
def test_another_format_is_refused_by_name(tmp_path, number):
    save_map(tmp_path, TILES, 1)
    path = tmp_path / "v000001" / "manifest.json"
    manifest = json.loads(path.read_text()) | {"format": number, "corridor": "9.0.0"}
    del manifest["sha256"]
    path.write_text(json.dumps(manifest | {"sha256": digest_of(manifest)}))
    with pytest.raises(InputError, match=rf"format {number} of corridor 9.0.0"):
        load_map(tmp_path)


def test_a_foreign_file_is_not_replaced(tmp_path):
    (tmp_path / "map.pgm").write_bytes(b"mine")
    with pytest.raises(StorageError, match="file of somebody else"):
        save_map(tmp_path, TILES, 1)
    assert (tmp_path / "map.pgm").read_bytes() == b"mine"


def test_a_copy_whose_links_became_files_is_saved_to_like_the_map(tmp_path):
    """As cp -rL makes it, and most sticks and archives."""
    save_map(tmp_path / "map", TILES, 1)
    save_map(tmp_path / "map", TILES, 2)
    copy = tmp_path / "copy"
    shutil.copytree(tmp_path / "map", copy)
    assert not (copy / "current").is_symlink()
    assert save_map(copy, TILES, 3) == 3
    assert os.readlink(copy / "current") == "v000003"
    assert (copy / "map.pgm").samefile(copy / "v000003" / "map.pgm")
    assert check_versions(copy) == ([1, 2, 3], [])
    assert not list(copy.glob(".unfinished-*"))


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 100_000, "maximum recursion"),
        ("[]", "no JSON object"),
        ("{}", "its own checksum"),
        ("", "char 0"),
    ],
)
def test_a_manifest_that_is_something_else_is_damage(tmp_path, text, why):
    save_map(tmp_path, TILES, 1)
    (tmp_path / "v000001" / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=f"manifest.json: damaged: .*{why}"):
        load_map(tmp_path)


@pytest.mark.parametrize(("name", "why"), [("a" * 300, "File name too long"), ("a\0b", "embedded null")])
def test_a_path_that_the_system_refuses_holds_no_map(tmp_path, name, why):
    for read in (load_map, check_versions):
        with pytest.raises(InputError, match=f"no stored map that can be read.*{why}"):
            read(tmp_path / name)
    if "\0" not in name:
        with pytest.raises(StorageError, match=why):
            save_map(tmp_path / name, TILES, 1)


def test_two_writers_do_not_meet(tmp_path):
    with files.only_writer(tmp_path), pytest.raises(StorageError, match="another process is writing"):
        save_map(tmp_path, TILES, 1)


def test_a_writer_that_locked_what_another_one_had_just_removed_does_not_write(tmp_path, monkeypatch):
    def removed(*_: object) -> None:
        (tmp_path / ".lock").unlink()

    monkeypatch.setattr(files.fcntl, "flock", removed)
    with pytest.raises(StorageError, match="another process is writing"), files.only_writer(tmp_path):
        pass


def test_a_full_disk_leaves_the_version_before(tmp_path, monkeypatch):
    def no_room(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(files, "write_png", no_room)
        with pytest.raises(StorageError, match=r"No space left on device$"):
            save_map(tmp_path, TILES, 1)
    save_map(tmp_path, TILES, 1)
    monkeypatch.setattr(files, "write_png", no_room)
    with pytest.raises(StorageError, match="No space left on device; the version before is untouched"):
        save_map(tmp_path, TILES, 2)
    assert load_map(tmp_path).saved_ns == 1
    assert sorted(path.name for path in tmp_path.glob("*v*")) == ["v000001"]


def test_a_kill_while_an_old_version_goes_leaves_no_half_of_it(tmp_path, monkeypatch):
    def half_gone(path: Path) -> None:
        (path / "manifest.json").unlink()
        raise Killed

    for version in range(1, KEEP_VERSIONS + 1):
        save_map(tmp_path, [tile(0, 0, version)], version)
    monkeypatch.setattr(files.shutil, "rmtree", half_gone)
    with pytest.raises(Killed):
        save_map(tmp_path, [tile(0, 0, 4)], 4)
    monkeypatch.undo()
    assert check_versions(tmp_path) == ([2, 3, 4], [])
    save_map(tmp_path, [tile(0, 0, 5)], 5)
    assert check_versions(tmp_path) == ([3, 4, 5], [])
    assert not list(tmp_path.glob(".unfinished-*"))


@pytest.fixture(scope="module")
def two_versions(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    for version in (1, 2):
        save_map(folder, [tile(0, 0, version, value=0)], version, graph=graph_of(4 * version))
    return folder


@pytest.mark.parametrize("step", range(60))
def test_a_kill_at_any_call_of_the_system_leaves_the_old_or_the_new_map(
    two_versions, tmp_path, monkeypatch, step
):
    """Each call that changes the folder is once the last one made before the process is gone."""
    shutil.copytree(two_versions, tmp_path, symlinks=True, dirs_exist_ok=True)
    calls = 0

    def counted(call):
        def once(*args, **kwargs):
            nonlocal calls
            calls += 1
            if calls > step:
                raise Killed
            return call(*args, **kwargs)

        return once

    for name in ("mkdir", "rename", "replace", "symlink_to", "unlink", "write_text"):
        monkeypatch.setattr(Path, name, counted(getattr(Path, name)))
    for module, name in ((files.np, "savez_compressed"), (files, "write_png"), (files, "write_ros_map")):
        monkeypatch.setattr(module, name, counted(getattr(module, name)))
    for name in ("fsync", "link"):
        monkeypatch.setattr(os, name, counted(getattr(os, name)))
    monkeypatch.setattr(files.shutil, "rmtree", counted(files.shutil.rmtree))
    killed = False
    try:
        save_map(tmp_path, [tile(0, 0, 3, value=100)], 3, graph=graph_of(12))
    except Killed:
        killed = True
    monkeypatch.undo()
    assert killed == (step < calls)
    stored = load_map(tmp_path)
    assert stored.problems == []
    assert stored.saved_ns in ((2, 3) if killed else (3,))
    assert len(stored.graph) == 4 * stored.saved_ns
    assert (read_ros_map(tmp_path / "map.yaml").cells == (100 if stored.saved_ns == 3 else 0)).all()
    # The next save is not hindered by what lies about.
    assert save_map(tmp_path, [tile(0, 0, 4)], 4) in (3, 4)
    assert load_map(tmp_path).saved_ns == 4
    assert not list(tmp_path.glob(".unfinished-*"))


def test_a_map_keeps_where_it_lies_on_the_earth_and_map_yaml_is_the_same(tmp_path):
    save_map(tmp_path / "there", TILES, 1, geo=GEO)
    save_map(tmp_path / "nowhere", TILES, 1)
    assert load_map(tmp_path / "there").geo == GEO
    assert load_map(tmp_path / "nowhere").geo is None
    assert read_geo(tmp_path / "there" / "geo.json") == GEO
    yaml = [(tmp_path / name / "map.yaml").read_bytes() for name in ("there", "nowhere")]
    assert yaml[0] == yaml[1]
    save_map(tmp_path / "there", TILES, 2)
    assert not (tmp_path / "there" / "geo.json").is_symlink()
    assert load_map(tmp_path / "there").geo is None
