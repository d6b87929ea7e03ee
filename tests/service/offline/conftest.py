"""Recorded drives for all who replay them, and the stored map that is bent for all who edit it."""

import shutil
from pathlib import Path

import pytest

from service.mapstore.files import save_map
from tests.service.mapstore.tile_makers import tile
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


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """A stored map without a graph."""
    save_map(tmp_path / "picture", [tile(0, 0, 1, value=97), tile(1, 0, 2, value=97)], 1)
    return tmp_path / "picture"
