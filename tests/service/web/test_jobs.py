"""The process in which maps of a running session are looked at and changed."""

import os
import signal
from pathlib import Path

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


def children() -> set[int]:
    """Process ids."""
    return set(map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()))


def test_one_process_answers_all_questions_and_another_replaces_it_after_its_death(process, office):
    others = children()
    seen = process.ask("look", office, {})
    assert seen["keyframes"] is None
    (first,) = children() - others
    with pytest.raises(ResourceError, match="there is no key frame 0 in this map"):
        process.ask("keyframe", office, {"seen": seen["seen"], "keyframe": 0})
    assert children() - others == {first}
    os.kill(first, signal.SIGKILL)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
    assert process.ask("look", office, {})["version"] == 1
    (second,) = children() - others
    assert second != first
    process.close()
    assert not children() - others


def test_a_process_that_dies_at_a_question_is_reported_in_words(process, office, monkeypatch):
    monkeypatch.setattr("service.web.jobs._gentle", lambda *arguments: ["false"])
    with pytest.raises(ResourceError, match=r"has ended|was ended"):
        process.ask("look", office, {})
