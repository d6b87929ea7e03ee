"""The process in which maps of a running session are looked at and changed; the real one is at work in
tests/browser/test_edit_live.py.
"""

import os
import signal
import sys
from pathlib import Path

import pytest

from service.web import jobs
from service.web.jobs import ResourceError, SessionMapProcess

ANSWERS = """
import json, sys
for line in sys.stdin:
    asked = json.loads(line)
    answer = {"map": asked["map"]} if asked["verb"] == "look" else {"error": f"no {asked['request']}"}
    print(json.dumps({"ok": asked["verb"] == "look", **answer}), flush=True)
"""
OFFICE = Path("maps/office")


@pytest.fixture
def process():
    made = SessionMapProcess()
    yield made
    made.close()


def children() -> set[int]:
    """Process ids."""
    return set(map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()))


def test_one_process_answers_all_questions_and_another_replaces_it_after_its_death(process, monkeypatch):
    monkeypatch.setattr(jobs, "_gentle", lambda *arguments: [sys.executable, "-S", "-c", ANSWERS])
    others = children()
    assert process.ask("look", OFFICE, {}) == {"map": str(OFFICE)}
    (first,) = children() - others
    with pytest.raises(ResourceError, match=r"no \{'keyframe': 0\}"):
        process.ask("keyframe", OFFICE, {"keyframe": 0})
    assert children() - others == {first}
    os.kill(first, signal.SIGKILL)
    os.waitid(os.P_PID, first, os.WEXITED | os.WNOWAIT)
    assert process.ask("look", OFFICE, {}) == {"map": str(OFFICE)}
    (second,) = children() - others
    assert second != first
    process.close()
    assert not children() - others


def test_a_process_that_dies_at_a_question_is_reported_in_words(process, monkeypatch):
    monkeypatch.setattr(jobs, "_gentle", lambda *arguments: ["false"])
    with pytest.raises(ResourceError, match=r"has ended|was ended"):
        process.ask("look", OFFICE, {})
