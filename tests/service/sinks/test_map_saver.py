import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.encoding import Message, decode_grid
from service.errors import StorageError
from service.mapstore.config import MapConfig
from service.mapstore.files import check_versions, load_map, save_map
from service.mapstore.graph_files import GraphFolder
from service.mapstore.tiles import TileStore
from service.offline.maps.edit import edit_map, erase
from service.outputs import TileUpdate
from service.publishing.commands import Answer
from service.sinks.map_saver import MAX_ASKED, MapSaver
from service.sinks.sink import SavedMap
from tests.service.mapstore.tile_makers import GEO, graph_of
from tests.service.sinks.contexts import sink_context
from tests.waiting import wait_until

UNUSED_PID = 4_194_305  # above every process id that Linux gives


def tile(version: int) -> TileUpdate:
    return TileUpdate(0, 0, 0, version, 0.05, np.full((8, 8), 100, np.int8))


def saver_in(
    folder: Path, checkpoint_s: float = 3600.0, load: Path | None = None, **context: Any
) -> MapSaver:
    config = MapConfig.model_construct(directory=folder, load=load, checkpoint_s=checkpoint_s)
    return MapSaver(config, sink_context(**context))


class Kept:
    """A map saver with its store and what it emitted."""

    def __init__(self, folder: Path, checkpoint_s: float = 30.0) -> None:
        self.tiles = TileStore()
        self.emitted: list[Message] = []
        self.emitted_one = threading.Event()
        self.saver = saver_in(folder, checkpoint_s, tiles=self.tiles, map_folder=folder, emit=self._emit)

    def _emit(self, message: Message) -> None:
        self.emitted.append(message)
        self.emitted_one.set()


def test_the_map_is_recorded_and_saved_at_the_end(tmp_path: Path):
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(3)])
    kept.saver.flush()
    assert [message.channel for message in kept.emitted] == ["map"]
    assert (decode_grid(kept.emitted[0].payload).cells == 100).all()
    stored = load_map(tmp_path / "map")
    assert [t.version for t in stored.tiles] == [3]
    assert stored.about == {"vehicle": "veh1", "profile": "corridor"}


def test_checkpoints_are_made_until_asked_to_stop(tmp_path: Path):
    kept = Kept(tmp_path / "map", checkpoint_s=0.01)
    kept.tiles.update([tile(1)])
    kept.saver.start()
    assert kept.emitted_one.wait(10.0)
    kept.tiles.update([tile(2)])
    wait_until(lambda: kept.saver.saved_version == 2)
    kept.saver.flush()
    assert [t.version for t in load_map(tmp_path / "map").tiles] == [2]


class Answers:
    """What a map saver says to whoever asked it to save."""

    def __init__(self) -> None:
        self.came = threading.Semaphore(0)
        self.heard: list[tuple[SavedMap | None, str]] = []

    def __call__(self, saved: SavedMap | None, fault: str) -> None:
        self.heard.append((saved, fault))
        self.came.release()


@pytest.fixture
def answers() -> Answers:
    return Answers()


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Kept]:
    """A map saver whose thread runs and whose checkpoints are far away."""
    kept = Kept(tmp_path / "map", checkpoint_s=3600.0)
    kept.saver.start()
    yield kept
    kept.saver.flush()
    assert not any(thread.name == "map-saver" for thread in threading.enumerate())


def test_requests_do_not_pile_up_without_end_while_the_disk_hangs(tmp_path: Path, answers: Answers):
    kept = Kept(tmp_path / "map")  # its thread takes none
    kept.tiles.update([tile(1)])
    heard_put_away: list[bool] = []
    kept.saver.put_graph_away(lambda: heard_put_away.append(True))
    for _ in range(MAX_ASKED - 1):
        kept.saver.ask_to_save(answers)
    assert answers.heard == []
    kept.saver.ask_to_save(answers)
    why = (
        f"{MAX_ASKED} requests wait for the disk of {tmp_path}; look whether it is full, slow or gone, and "
        "ask again"
    )
    assert answers.heard == [(None, f"not saved: {why}")]
    with pytest.raises(StorageError) as error:
        kept.saver.put_graph_away(lambda: heard_put_away.append(False))
    assert str(error.value) == why
    kept.saver.flush()
    assert answers.heard[1:] == [(SavedMap(tmp_path / "map", 1, 1), "")] * (MAX_ASKED - 1)
    assert heard_put_away == [True]


def test_a_name_that_the_disk_refuses_is_reported_and_the_next_save_is_made(
    running: Kept, answers: Answers, tmp_path: Path
):
    running.tiles.update([tile(1)])
    running.saver.ask_to_save(answers)
    assert answers.came.acquire(timeout=10.0)
    (tmp_path / "map" / "notes").write_text("in the way")
    running.saver.ask_to_save(answers, "notes")
    assert answers.came.acquire(timeout=10.0)
    saved, fault = answers.heard[1]
    assert saved is None
    assert f"cannot save the map to {tmp_path}/map/notes: File exists" in fault
    running.tiles.update([tile(2)])
    running.saver.ask_to_save(answers)
    assert answers.came.acquire(timeout=10.0)
    assert answers.heard[2] == (SavedMap(tmp_path / "map", 2, 2), "")


def test_a_map_that_the_disk_refused_is_saved_later_even_after_resets(tmp_path: Path, answers: Answers):
    (tmp_path / "map").write_text("in the way")
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(1)])
    kept.tiles.start_over()
    kept.tiles.update([tile(5)])
    kept.saver.ask_to_save(answers)
    with pytest.raises(StorageError, match="cannot save the map"):
        kept.saver.flush()
    assert answers.heard[0][0] is None
    assert "cannot save the map" in answers.heard[0][1]
    (tmp_path / "map").unlink()
    kept.tiles.start_over()
    assert not (tmp_path / "map_2").exists()
    kept.saver.flush()
    assert [t.version for t in load_map(tmp_path / "map").tiles] == [1]
    assert [t.version for t in load_map(tmp_path / "map_2").tiles] == [5]
    assert kept.saver.newest == SavedMap(tmp_path / "map_2", 1, 5)


def test_a_map_after_a_reset_has_no_folder_to_resume_in_until_it_is_saved(tmp_path: Path):
    """The pose is of the new map: in that before it would be another place."""
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(1)])
    assert kept.saver.stored_folder is None
    kept.saver.save()
    assert kept.saver.stored_folder == tmp_path / "map"
    kept.tiles.start_over()
    kept.saver.begun_new()
    kept.saver.save()
    assert kept.saver.stored_folder is None
    kept.saver.begun_in(tmp_path / "office")
    assert kept.saver.stored_folder == tmp_path / "office"


def test_where_the_map_lies_is_saved_with_it_and_again_when_that_alone_changed(tmp_path: Path):
    kept = Kept(tmp_path / "map")
    kept.tiles.update([tile(1)])
    for number, geo in enumerate((None, GEO, GEO, replace(GEO, fixes=50)), start=1):
        kept.tiles.place(geo)
        kept.saver.flush()
        assert load_map(tmp_path / "map").geo == geo
        assert load_map(tmp_path / "map").number == min(number, 2 + (number == 4))


def test_a_map_that_a_session_goes_on_in_is_not_edited_meanwhile(tmp_path: Path):
    save_map(tmp_path / "office", [tile(1)], 1)
    saver = saver_in(tmp_path, load=tmp_path / "office")
    saver.start()
    change = erase([0.0, 0.0, 0.1, 0.0, 0.1, 0.1], "unknown")
    try:
        with pytest.raises(StorageError, match="a session of veh1 uses this map"):
            edit_map(tmp_path / "office", "erase", change, "ada", 2)
        with pytest.raises(StorageError, match="a session of veh1 uses this map"):
            saver_in(tmp_path, load=tmp_path / "office").start()
        saver_in(tmp_path, load=tmp_path / "office", is_localizing=True).close()
    finally:
        saver.flush()
    assert edit_map(tmp_path / "office", "erase", change, "ada", 2)["version"] == 2


def gone_on_in(folder: Path, **context: Any) -> tuple[TileStore, MapSaver]:
    """A session that began in a stored map: its tiles, its saver, started."""
    save_map(folder, [tile(1)], 1, graph=graph_of(4))
    tiles = TileStore()
    saver = saver_in(folder.parent, load=folder, tiles=tiles, load_version=1, **context)
    saver.start()
    return tiles, saver


def test_the_version_that_a_session_began_in_outlives_its_checkpoints(tmp_path: Path):
    tiles, saver = gone_on_in(folder := tmp_path / "office")
    for version in range(2, 7):
        tiles.update([tile(version)])
        saver.save()
    saver.hold(folder, 5)  # load_map goes back to one
    for version in range(7, 12):
        tiles.update([tile(version)])
        saver.save()
    saver.flush()
    assert check_versions(folder)[0] == [1, 5, 9, 10, 11]


def test_a_stored_map_is_not_overtaken_by_a_version_that_no_one_can_go_on_in(
    tmp_path: Path, answers: Answers
):
    """Tiles come with the first scan, the graph with the first checkpoint."""
    tiles, saver = gone_on_in(folder := tmp_path / "office", stores_graph=True)
    try:
        tiles.update([tile(2)])
        saver.ask_to_save(answers)
        assert answers.came.acquire(timeout=20.0)
        why = "the graph of what was mapped since is not put away"
        assert answers.heard[0][0] is None
        assert answers.heard[0][1].startswith(f"{folder} stays as it is, for {why}; a replay of ")
        tiles.start_over()
        saver.save()
        assert check_versions(folder)[0] == [1]
    finally:
        saver.flush()


def test_a_map_that_someone_asks_for_is_saved_with_the_graph_of_now(tmp_path: Path, answers: Answers):
    """The mapper puts it away a moment after it was asked to."""
    tiles, kept = TileStore(), GraphFolder(tmp_path / "graphs")
    requested: list[str] = []

    def command(verb: str, payload: bytes) -> Answer:
        requested.append(verb)
        folder = Path(kept(graph_of(4 + len(requested))).folder)
        threading.Timer(0.05, tiles.keep_graph, [folder]).start()
        return Answer(True, b"{}")

    saver = saver_in(tmp_path, tiles=tiles, stores_graph=True, command=command)
    tiles.update([tile(3)])
    saver.start()
    try:
        for number, name in enumerate(("", "office")):
            saver.ask_to_save(answers, name, with_graph=True)
            assert answers.came.acquire(timeout=20.0)
            saved, _ = answers.heard[number]
            assert len(load_map(saved.folder).graph) == 5 + number
        assert requested == ["checkpoint", "checkpoint"]
    finally:
        saver.flush()


def test_the_graph_that_was_reported_last_stays_while_the_back_end_puts_away_others(tmp_path: Path):
    """As at the end of a run where the back end is given up after it has written more of them."""
    tiles = TileStore()
    saver = saver_in(tmp_path, tiles=tiles, stores_graph=True)
    keep = GraphFolder(saver.graph_folder / "map1")
    tiles.update([tile(3)])
    kept = [Path(keep(graph_of(count)).folder) for count in (4, 5, 6, 7)]
    for k, folder in enumerate(kept):
        os.utime(folder, (k, k))
    for facts, left in ((0, kept), (3, kept[2:])):
        tiles.keep_graph(kept[facts])
        saver.save()
        assert len(load_map(saver.folder).graph) == 4 + facts
        assert sorted(saver.graph_folder.glob("map1/*")) == left
    saver.flush()
    assert not saver.graph_folder.exists()


def test_the_graph_of_a_session_that_was_killed_is_removed_by_a_later_one(tmp_path: Path):
    long_gone, just_killed, living = (
        tmp_path / f".veh1_20251121T10000{k}Z.graph-{pid}"
        for k, pid in enumerate((UNUSED_PID, UNUSED_PID, os.getpid()))
    )
    for folder in (long_gone, just_killed, living):
        (folder / "map1").mkdir(parents=True)
    for folder in (long_gone, living):
        os.utime(folder, (1e9, 1e9))
    saver = saver_in(tmp_path, stores_graph=True)
    saver.start()
    saver.flush()
    assert sorted(tmp_path.iterdir()) == [just_killed, living]
