import threading
from pathlib import Path

import numpy as np
import pytest

from service.encoding import Message, decode_grid
from service.errors import StorageError
from service.mapstore.files import load_map
from service.mapstore.tiles import TileStore
from service.outputs import TileUpdate
from service.runtime.host_time import HostTime
from service.runtime.map_keeper import MapKeeper


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
    stop = threading.Event()
    thread = threading.Thread(target=kept.keeper.run, args=(stop,))
    thread.start()
    assert kept.recorded_one.wait(10.0)
    kept.tiles.update([tile(2)])
    deadline = threading.Event()
    for _ in range(1000):
        if kept.keeper.saved_version == 2:
            break
        deadline.wait(0.01)
    stop.set()
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
