"""Recorded drives for all who replay them, and the stored map that is bent for all who edit it."""

import shutil
from pathlib import Path

import pytest

from tests.service.offline.maps.bent_maps import BentMap, bent_map, save_bent
from tests.service.offline.recorded_drives import RecordDrive, recorder_in


@pytest.fixture
def record_drive(tmp_path: Path) -> RecordDrive:
    return recorder_in(tmp_path)


@pytest.fixture(scope="session")
def bent() -> BentMap:
    return bent_map()


@pytest.fixture(scope="session")
def bent_folder(tmp_path_factory: pytest.TempPathFactory, bent: BentMap) -> Path:
    return save_bent(tmp_path_factory.mktemp("bent") / "ring", bent)


@pytest.fixture
def folder(tmp_path: Path, bent_folder: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(bent_folder, tmp_path / "ring", symlinks=True))
