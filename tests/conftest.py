"""Fixtures that every test file may use."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real captures and recordings, $CORRIDOR_SHARED or ../shared; a skip says that there is none."""
    root = Path(os.environ.get("CORRIDOR_SHARED", Path(__file__).parents[2] / "shared"))
    if not (root / "captures").is_dir():
        pytest.skip(f"no real recordings at {root}; set CORRIDOR_SHARED to the folder that holds them")
    return root
