import os
import threading
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from service.mapstore.files import save_map
from service.outputs import TileUpdate
from service.web.jobs import ResourceError
from service.web.resources import DELETED, FORMATS, Resources

KINDS = ("session", "map")


@pytest.fixture
def folders(tmp_path):
    """Two sessions, one being recorded, a map of one tile, and things that are none of these."""
    sessions, maps = tmp_path / "sessions", tmp_path / "maps"
    for folder in (sessions, maps):
        folder.mkdir()
    for age_s, name in enumerate(("b.mcap", "a.mcap", "c.mcap.active")):
        (sessions / name).write_bytes(b"x" * 10)
        os.utime(sessions / name, (1000 - age_s, 1000 - age_s))
    (sessions / "notes.txt").write_text("no session")
    (maps / "no map").mkdir()
    save_map(maps / "office", [TileUpdate(0, 0, 0, 1, 0.05, np.zeros((64, 64), np.int8))], 1)
    return {"session": sessions, "map": maps}


@pytest.fixture
def used():
    return []


@pytest.fixture
def resources(folders, used, tmp_path):
    made = Resources(folders, lambda: used, tmp_path / "scratch")
    yield made
    made.close()


def names(resources, kind):
    return [entry["name"] for entry in resources.listing()[kind]]


def test_sessions_and_maps_are_listed_newest_first(resources):
    listing = resources.listing()
    assert [(e["name"], e["bytes"], e["changed_s"]) for e in listing["session"]] == [
        ("b.mcap", 10, 1000.0),
        ("a.mcap", 10, 999.0),
        ("c.mcap.active", 10, 998.0),
    ]
    assert [entry["in_use"] for entry in listing["session"]] == [False, False, True]
    (office,) = listing["map"]
    assert office["name"] == "office"
    assert office["bytes"] > 100
    assert listing["formats"]["session"][0] == "mcap"


def test_renamed_it_has_the_new_name_alone(resources, folders):
    assert resources.rename("session", "a.mcap", "lap-1") == "lap-1.mcap"
    assert (folders["session"] / "lap-1.mcap").read_bytes() == b"x" * 10
    assert not (folders["session"] / "a.mcap").exists()
    resources.rename("map", "office", "hall_2")
    assert names(resources, "map") == ["hall_2"]


@pytest.mark.parametrize(
    ("to", "words"),
    [
        *(
            (to, "is no name for a session")
            for to in ("", "..", "../x", "a/b", ".hidden", "x" * 101, "a b", "a\0b")
        ),
        ("b", r"there is a b\.mcap already"),
    ],
)
def test_a_name_that_is_none_or_taken_is_refused(resources, to, words):
    with pytest.raises(ResourceError, match=words):
        resources.rename("session", "a.mcap", to)
    assert "a.mcap" in names(resources, "session")


@pytest.mark.parametrize("name", ["..", "../maps/office", "/etc/passwd", "notes.txt", "", "no map"])
@pytest.mark.parametrize("kind", KINDS)
def test_only_what_is_listed_can_be_touched(resources, kind, name):
    with pytest.raises(ResourceError, match="there is no"):
        resources.delete(kind, name)
    with pytest.raises(ResourceError, match="there is no"):
        resources.download(kind, name, FORMATS[kind][0])


def test_deleted_it_is_gone_until_it_is_taken_back(resources, folders):
    number = resources.delete("session", "a.mcap")
    assert "a.mcap" not in names(resources, "session")
    assert resources.undo(number) == "a.mcap"
    assert (folders["session"] / "a.mcap").read_bytes() == b"x" * 10
    with pytest.raises(ResourceError, match="brought back already"):
        resources.undo(number)


def test_purge_erases_what_was_deleted(resources, folders):
    number = resources.delete("session", "a.mcap")
    assert (folders["session"] / DELETED / number / "a.mcap").exists()
    resources.purge()
    assert not (folders["session"] / DELETED).exists()
    assert names(resources, "session") == ["b.mcap", "c.mcap.active"]


def test_what_the_service_writes_to_stays(resources, folders, used):
    used.append(folders["map"] / "office")
    for action in (lambda: resources.delete("map", "office"), lambda: resources.rename("map", "office", "x")):
        with pytest.raises(ResourceError, match="in use"):
            action()
    with pytest.raises(ResourceError, match="being recorded"):
        resources.delete("session", "c.mcap.active")
    assert resources.listing()["map"][0]["in_use"]


def test_a_map_is_handed_out_whole_and_its_exports_as_files_or_zip(resources, folders, tmp_path):
    whole = resources.download("map", "office", "zip")
    with zipfile.ZipFile(whole.path) as archive:
        assert {"office/map.yaml", "office/map.pgm"} <= set(archive.namelist())
    picture = resources.download("map", "office", "pgm")
    with zipfile.ZipFile(picture.path) as archive:
        assert sorted(name for name in archive.namelist() if not name.endswith("/")) == [
            "office/office.pgm",
            "office/office.yaml",
        ]
    for download in (whole, picture):
        assert download.name == "office.zip"
        download.clean_up()
    assert list((tmp_path / "scratch").iterdir()) == []


def test_an_export_that_fails_says_why_and_leaves_nothing(resources, tmp_path):
    with pytest.raises(ResourceError, match=r"a\.mcap"):
        resources.download("session", "a.mcap", "tum")
    assert list((tmp_path / "scratch").iterdir()) == []


def test_a_format_that_there_is_not_is_refused(resources):
    with pytest.raises(ResourceError, match="a map is had as zip, png"):
        resources.download("map", "office", "exe")


def test_one_export_at_a_time(resources, monkeypatch):
    began, go_on = threading.Event(), threading.Event()

    def run(process, *arguments):
        began.set()
        assert go_on.wait(20.0)
        raise ResourceError("ended")

    monkeypatch.setattr("service.web.jobs.CommandProcess.run", run)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(resources.download, "map", "office", "png")
        assert began.wait(20.0)
        with pytest.raises(ResourceError, match="another export is being made"):
            resources.download("map", "office", "png")
        go_on.set()
        with pytest.raises(ResourceError, match="ended"):
            first.result(20.0)
