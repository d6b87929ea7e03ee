from collections.abc import Callable

import pytest

from service.runtime import mapper_link
from tests.service.runtime.mappers import HOW


@pytest.fixture
def strange(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Sets up how the mapper misbehaves: "raises", "hangs", "does not compile", "compiles for ever"; or
    "not at all", with a new stand-by every 0.3 s.
    """

    def set_up(how: str) -> None:
        monkeypatch.setattr(mapper_link, "MODULE", "tests.service.runtime.mappers.strange")
        monkeypatch.setenv(HOW, how)

    return set_up
