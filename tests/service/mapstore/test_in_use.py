from pathlib import Path

import pytest

from service.errors import StorageError
from service.mapstore.in_use import InUse, MapsInUse


def test_one_holds_a_map_until_it_lets_go_and_the_other_hears_who(tmp_path: Path):
    first = InUse(tmp_path, "a session of veh1")
    with pytest.raises(StorageError, match="a session of veh1 uses this map"):
        InUse(tmp_path, "an edit")
    first.release()
    with InUse(tmp_path, "an edit"), pytest.raises(StorageError, match="an edit uses this map"):
        InUse(tmp_path, "a session of veh1")


def test_a_disk_that_takes_nothing_is_reported_and_leaves_the_map_free(tmp_path: Path):
    (tmp_path / ".in_use").symlink_to("/dev/full")
    with pytest.raises(StorageError, match=str(tmp_path)):
        InUse(tmp_path, "a session of veh1")
    (tmp_path / ".in_use").unlink()
    with InUse(tmp_path, "an edit"):
        pass


def test_a_folder_that_is_gone_is_reported(tmp_path: Path):
    with pytest.raises(StorageError, match="gone"):
        InUse(tmp_path / "gone", "an edit")


def test_a_map_that_a_session_needs_twice_is_free_when_it_was_let_go_twice(tmp_path: Path):
    maps = MapsInUse("a session of veh1")
    maps.hold(tmp_path)
    maps.hold(tmp_path)
    maps.let_go(tmp_path)
    with pytest.raises(StorageError, match="a session of veh1 uses this map"):
        InUse(tmp_path, "an edit")
    maps.let_go(tmp_path)
    with InUse(tmp_path, "an edit"), pytest.raises(StorageError, match="an edit uses this map"):
        maps.hold(tmp_path)
    maps.hold(tmp_path)
    maps.let_all_go()
    maps.let_go(tmp_path)
    with InUse(tmp_path, "an edit"):
        pass
