"""Fixtures that every test file may use."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real captures and recordings ($CORRIDOR_SHARED, default ../shared), or a skip that says so."""
    root = Path(os.environ.get("CORRIDOR_SHARED", Path(__file__).parents[2] / "shared"))
    if not (root / "captures").is_dir():
        pytest.skip(f"no real recordings at {root}; set CORRIDOR_SHARED to the folder that holds them")
    return root
