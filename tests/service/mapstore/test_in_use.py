from pathlib import Path

import pytest

from service.errors import StorageError
from service.mapstore.in_use import InUse


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
