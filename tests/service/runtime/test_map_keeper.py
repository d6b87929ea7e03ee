import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from service.encoding import Message, decode_grid
from service.errors import StorageError
from service.geometry.geo_reference import GeoReference
from service.geometry.geodesy import LocalFrame
from service.geometry.se2 import SE2
from service.mapstore.files import load_map
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.runtime.host_time import HostTime
from service.runtime.map_keeper import MOST_UNSAVED, MapKeeper, SavedMap

GEO = GeoReference(LocalFrame(60.161, 24.546, 51.7), SE2(3.0, -4.0, 0.0), 0.8, 0.01, 41)


def tile(version: int) -> TileUpdate:
    return TileUpdate(0, 0, 0, version, 0.05, np.full((8, 8), 100, np.int8))


class Kept:
    """A keeper with its store and what it recorded."""

    def __init__(self, folder: Path, checkpoint_s: float = 30.0) -> None:
        self.tiles = TileStore()
        self.recorded: list[Message] = []
        self.recorded_one = threading.Event()
        about = {"vehicle": "veh1", "profile": "corridor"}
        self.keeper = MapKeeper(folder, self.tiles, HostTime(0), checkpoint_s, about, self._record)

    def _record(self, message: Message) -> None:
        self.recorded.append(message)
        self.recorded_one.set()


def test_the_map_is_recorded_and_saved_at_the_end(tmp_path: Path):
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(3)])
    kept.keeper.finish()
    assert [message.channel for message in kept.recorded] == ["map"]
    assert (decode_grid(kept.recorded[0].payload).cells == 100).all()
    stored = load_map(tmp_path / "map")
    assert [t.version for t in stored.tiles] == [3]
    assert stored.about == {"vehicle": "veh1", "profile": "corridor"}


def test_what_did_not_change_is_neither_recorded_nor_saved_again(tmp_path: Path):
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(1)])
    kept.keeper.finish()
    kept.keeper.finish()
    assert len(kept.recorded) == 1
    assert load_map(tmp_path / "map").number == 1
    kept.tiles.update([tile(2)])
    kept.keeper.finish()
    assert len(kept.recorded) == 2
    assert load_map(tmp_path / "map").number == 2


def test_an_empty_map_leaves_nothing(tmp_path: Path):
    kept = Kept(tmp_path / "map")
    kept.keeper.finish()
    assert not kept.recorded
    assert not (tmp_path / "map").exists()
    assert kept.keeper.saved_version == 0


def test_checkpoints_are_made_on_the_way_until_told_to_stop(tmp_path: Path):
    kept = Kept(tmp_path / "map", checkpoint_s=0.01)
    kept.tiles.update([tile(1)])
    thread = threading.Thread(target=kept.keeper.run)
    thread.start()
    assert kept.recorded_one.wait(10.0)
    kept.tiles.update([tile(2)])
    deadline = threading.Event()
    for _ in range(1000):
        if kept.keeper.saved_version == 2:
            break
        deadline.wait(0.01)
    kept.keeper.stop()
    thread.join(10.0)
    assert kept.keeper.saved_version == 2
    assert [t.version for t in load_map(tmp_path / "map").tiles] == [2]


def test_a_folder_that_cannot_be_written_is_health_on_the_way_and_an_error_at_the_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    (tmp_path / "map").write_text("in the way")
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(1)])
    kept.keeper._try_to_save()
    kept.keeper._try_to_save()
    assert "cannot save the map" in kept.keeper.trouble
    assert caplog.text.count("cannot save the map") == 1
    with pytest.raises(StorageError, match="cannot save the map"):
        kept.keeper.finish()
    (tmp_path / "map").unlink()
    kept.keeper.finish()
    assert kept.keeper.trouble == ""


class Answers:
    """What a keeper says to whoever asked it to save."""

    def __init__(self) -> None:
        self.came = threading.Semaphore(0)
        self.heard: list[tuple[SavedMap | None, str]] = []

    def __call__(self, saved: SavedMap | None, trouble: str) -> None:
        self.heard.append((saved, trouble))
        self.came.release()


@pytest.fixture
def answers() -> Answers:
    return Answers()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Kept]:
    """A keeper whose thread runs and whose checkpoints are far away."""
    kept = Kept(tmp_path / "map", checkpoint_s=3600.0)
    thread = threading.Thread(target=kept.keeper.run)
    thread.start()
    yield kept
    kept.keeper.stop()
    thread.join(10.0)
    assert not thread.is_alive()


def test_who_asks_hears_where_the_map_is_once_it_is_there(running: Kept, answers: Answers, tmp_path: Path):
    running.keeper.ask_to_save(answers)
    assert answers.came.acquire(timeout=10.0)
    running.tiles.update([tile(4)])
    for _ in range(2):  # the second time there is nothing new to save
        running.keeper.ask_to_save(answers)
        assert answers.came.acquire(timeout=10.0)
    saved = SavedMap(tmp_path / "map", 1, 4)
    assert answers.heard == [(None, ""), (saved, ""), (saved, "")]
    assert load_map(tmp_path / "map").number == 1


def test_the_map_before_a_reset_is_saved_whole_and_the_next_goes_beside_it(
    running: Kept, answers: Answers, tmp_path: Path
):
    running.tiles.update([tile(1)])
    running.tiles.begin_anew()
    running.keeper.ask_to_save(answers)
    assert answers.came.acquire(timeout=10.0)
    assert answers.heard == [(None, "")]  # of the present map there is nothing yet
    assert running.keeper.newest == SavedMap(tmp_path / "map", 1, 1)
    assert (running.keeper.folder, running.keeper.saved_version) == (tmp_path / "map_2", 0)
    assert not (tmp_path / "map_2").exists()
    running.tiles.update([tile(3)])
    running.keeper.ask_to_save(answers)
    assert answers.came.acquire(timeout=10.0)
    assert answers.heard[1] == (SavedMap(tmp_path / "map_2", 1, 3), "")
    assert [t.version for t in load_map(tmp_path / "map").tiles] == [1]
    assert [t.version for t in load_map(tmp_path / "map_2").tiles] == [3]


def test_a_map_that_the_disk_refused_is_saved_later_even_after_resets(tmp_path: Path, answers: Answers):
    (tmp_path / "map").write_text("in the way")
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(1)])
    kept.tiles.begin_anew()
    kept.tiles.update([tile(5)])
    kept.keeper.ask_to_save(answers)
    with pytest.raises(StorageError, match="cannot save the map"):
        kept.keeper.finish()
    assert answers.heard[0][0] is None
    assert "cannot save the map" in answers.heard[0][1]
    (tmp_path / "map").unlink()
    kept.tiles.begin_anew()
    kept.keeper.finish()
    assert [t.version for t in load_map(tmp_path / "map").tiles] == [1]
    assert [t.version for t in load_map(tmp_path / "map_2").tiles] == [5]
    assert kept.keeper.newest == SavedMap(tmp_path / "map_2", 1, 5)


def test_unsaved_maps_do_not_pile_up_without_end(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "map").write_text("in the way")
    kept = Kept(tmp_path / "map")
    for _ in range(MOST_UNSAVED + 1):
        kept.tiles.update([tile(kept.tiles.version + 1)])
        kept.tiles.begin_anew()
    kept.keeper._try_to_save()
    assert "map 1 is given up" in caplog.text
    assert len(kept.keeper._unsaved) == 0  # only the first had something in its way


def test_where_the_map_lies_is_saved_with_it_and_anew_when_that_alone_changed(tmp_path: Path):
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(1)])
    for number, geo in enumerate((None, GEO, GEO, replace(GEO, fixes=50)), start=1):
        kept.tiles.place(geo)
        kept.keeper.finish()
        assert load_map(tmp_path / "map").geo == geo
        assert load_map(tmp_path / "map").number == min(number, 2 + (number == 4))
