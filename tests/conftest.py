"""Fixtures that every test file may use."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from service.kernel_cache import ensure_cache_dir

ensure_cache_dir()  # before anything imports numba: what is compiled from now on is kept

hypothesis.settings.register_profile("corridor", deadline=None)  # a core may be busy with other things
hypothesis.settings.load_profile("corridor")


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real captures and recordings, $CORRIDOR_SHARED or ../shared; else a skip says so."""
    root = Path(os.environ.get("CORRIDOR_SHARED", Path(__file__).parents[2] / "shared"))
    if not (root / "captures").is_dir():
        pytest.skip(f"no real recordings at {root}; set CORRIDOR_SHARED to the folder that holds them")
    return root


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """Commands configure the root logger: the next test sees neither its level nor a closed stream."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:], root.level = handlers, level
