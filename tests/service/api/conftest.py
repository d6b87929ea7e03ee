from pathlib import Path

import pytest

import corridor
from tests.service.api.rooms import recorded
from tests.service.publishing.conftest import open_publisher, publisher, store

__all__ = ["open_publisher", "publisher", "store"]  # fixtures


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("recorded"))


@pytest.fixture(scope="session")
def replayed(recording: Path) -> corridor.Result:
    return corridor.replay(recording)


@pytest.fixture(scope="session")
def stored(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the map of the drive."""
    folder = tmp_path_factory.mktemp("stored") / "room"
    opened = corridor.read(recording)
    mapper = corridor.Mapper(opened)
    for frame in opened:
        mapper.process(frame)
    assert mapper.save(folder) == 1
    return folder
