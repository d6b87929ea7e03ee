import pytest

from service.recording.mcap_recorder import McapRecorder
from tests.service.recording.foreign import Foreign
from tests.service.recording.sessions import PLENTY


@pytest.fixture
def recorder(tmp_path):
    """Starts recorders into tmp_path and finishes them all."""
    started = []

    def start(**options) -> McapRecorder:
        made = McapRecorder(tmp_path, "veh1", **({"free_bytes_of": lambda _: PLENTY} | options))
        made.start()
        started.append(made)
        return made

    yield start
    for made in started:
        made.finish()


@pytest.fixture
def foreign(tmp_path) -> Foreign:
    return Foreign(tmp_path / "foreign.mcap")
