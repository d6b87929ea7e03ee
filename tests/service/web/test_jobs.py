"""The process in which maps of a running session are looked at and changed."""

import os
import signal

import numpy as np
import pytest

from service.mapstore.files import save_map
from service.outputs import TileUpdate
from service.web.jobs import ResourceError, SessionMapProcess


@pytest.fixture
def office(tmp_path):
    save_map(tmp_path / "office", [TileUpdate(0, 0, 0, 1, 0.05, np.zeros((64, 64), np.int8))], 1)
    return tmp_path / "office"


@pytest.fixture
def process():
    made = SessionMapProcess()
    yield made
    made.close()


def pid_of(process):
    return process._process.pid


def test_one_process_answers_all_questions_and_another_replaces_it_after_its_death(process, office):
    seen = process.ask("look", office, {})
    assert seen["keyframes"] is None
    first = process._process
    with pytest.raises(ResourceError, match="there is no key frame 0 in this map"):
        process.ask("keyframe", office, {"seen": seen["seen"], "keyframe": 0})
    assert process.ask("look", office, {})["version"] == 1
    assert pid_of(process) == first.pid
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    assert process.ask("look", office, {})["version"] == 1
    second = pid_of(process)
    assert second != first.pid
    process.close()
    with pytest.raises(ProcessLookupError):
        os.kill(second, 0)


def test_a_process_that_dies_at_a_question_is_reported_in_words(process, office, monkeypatch):
    monkeypatch.setattr("service.web.jobs._gentle", lambda *arguments: ["false"])
    with pytest.raises(ResourceError, match=r"has ended|was ended"):
        process.ask("look", office, {})
