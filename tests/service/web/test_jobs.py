"""The process in which maps of a running session are looked at and changed; the real one is at work in
tests/browser/test_edit_live.py.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from service.web import jobs
from service.web.jobs import CommandProcess, ResourceError, SessionMapProcess
from tests.in_background import started
from tests.processes import alive
from tests.waiting import wait_until

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
    return {one.pid for one in alive() if one.parent == os.getpid()}


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


def test_a_command_ends_with_the_service_and_none_begins_after_it(monkeypatch):
    """An export of a long session takes minutes: the service waited for it at its end."""
    monkeypatch.setattr(jobs, "_gentle", lambda *arguments: ["sleep", "60"])
    process, others = CommandProcess(), children()
    running = started(lambda: process.run("export"))
    wait_until(lambda: children() - others, words="no process was begun")
    process.close()
    with pytest.raises(ResourceError, match="the service is stopping"):
        running.result(20.0)
    assert not children() - others
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process is begun"))
    with pytest.raises(ResourceError, match="the service is stopping"):
        process.run("export")
