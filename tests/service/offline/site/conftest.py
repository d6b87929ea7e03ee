"""A ring of corridors seen with few beams, in which few places are searched."""

from collections.abc import Iterator

import pytest

from service.mapper.graph.edit import merging
from tests.service.mapper.graph.loops import rings

BEAMS = 91


@pytest.fixture(scope="module")
def few_beams_and_questions() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rings, "BEAMS", BEAMS)
        patch.setattr(rings, "STEP_RAD", -2.0 * rings.FIRST_RAD / (BEAMS - 1))
        patch.setattr(merging, "MAX_PLACES_MISSED", 2)
        yield
