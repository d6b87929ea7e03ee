"""The stored map that is bent, for all who edit it; see bent_maps."""

from pathlib import Path

import pytest

from tests.service.offline.maps.bent_maps import BentMap, bent_map, save_bent


@pytest.fixture(scope="session")
def bent() -> BentMap:
    return bent_map()


@pytest.fixture
def folder(tmp_path: Path, bent: BentMap) -> Path:
    return save_bent(tmp_path / "ring", bent)
