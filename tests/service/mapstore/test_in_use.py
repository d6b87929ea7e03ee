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
