from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from service.runtime import early_mapper, mapper_link
from tests.service.runtime.machine import Machine
from tests.service.runtime.mappers import HOW
from tests.service.runtime.mappers.forked import Nursery


@pytest.fixture(scope="session")
def nursery() -> Iterator[Nursery]:
    opened = Nursery()
    yield opened
    opened.close()


@pytest.fixture
def forked_mappers(nursery: Nursery, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mappers begin within milliseconds, as copies of one that has imported and loaded all."""
    monkeypatch.setattr(mapper_link, "subprocess", nursery)


@pytest.fixture
def strange(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Sets up how the mapper misbehaves: "raises", "hangs", "computes", "does not compile",
    "compiles for ever"; or "says what it loads", "not at all", with a new stand-by every 0.3 s.
    """

    def set_up(how: str) -> None:
        for module in (mapper_link, early_mapper):
            monkeypatch.setattr(module, "MODULE", "tests.service.runtime.mappers.strange")
        monkeypatch.setenv(HOW, how)

    return set_up


@pytest.fixture
def free_bytes() -> list[int]:
    return [1 << 40]


@pytest.fixture
def machine(tmp_path: Path, free_bytes: list[int]) -> Iterator[Machine]:
    made = Machine(tmp_path, free_bytes)
    made.start()
    yield made
    made.stop()
