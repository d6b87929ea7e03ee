import json
import queue
import threading
from concurrent.futures import Future
from functools import partial
from typing import Annotated, Any

import pytest
from pydantic import Field

from service.publishing import commands
from service.publishing.commands import REMEMBER_S, CommandDispatcher, CommandError, Outcome, Request, Verb
from tests.in_background import started


class Paint(Request):
    colour: Annotated[str, Field(min_length=1, max_length=5)]


class Workshop:
    """Verbs that note what was begun and settle at once, unless asked to wait."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.begun: list[Request] = []
        self.outcomes: list[Outcome] = []
        self.settles = True
        self.refuses = ""
        verbs = {"render": Verb(Paint, self._start), "wash": Verb(Request, self._start)}
        self.dispatcher = CommandDispatcher(verbs, answer_timeout_s=0.05, monotonic_s=lambda: self.now_s)

    def _start(self, request: Request, outcome: Outcome) -> None:
        if self.refuses:
            raise CommandError(self.refuses)
        self.begun.append(request)
        self.outcomes.append(outcome)
        if self.settles:
            outcome.done(number=len(self.begun))

    def ask(self, verb: str, request: object = None) -> dict[str, Any]:
        payload = request if isinstance(request, bytes) else json.dumps(request).encode() if request else b""
        answer = self.dispatcher.answer(verb, payload)
        facts: dict[str, Any] = json.loads(answer.body)
        assert facts["ok"] is answer.ok
        return facts


@pytest.fixture
def workshop() -> Workshop:
    return Workshop()


@pytest.mark.parametrize(
    ("verb", "request_", "words"),
    [
        ("iron", {}, "there is no command 'iron'; known: render, wash"),
        ("render", b"red", "the payload is no JSON: Expecting value: line 1 column 1 (char 0); expected "),
        ("render", b"\xff\xfe\xfd", "the payload is no JSON: "),
        ("render", b"[" * 60_000, "the payload is no JSON: "),
        ("render", b'["red"]', 'the payload is no JSON object; expected {"colour": ..., "id": ...}'),
        ("render", None, '\'colour\' is missing; expected {"colour": ..., "id": ...} (id may be left out)'),
        ("render", {"color": "red"}, "unknown key 'color', did you mean 'colour'?"),
        ("wash", {"hot": True}, "unknown key 'hot'; expected {\"id\": ...} (id may be left out)"),
        ("render", {"colour": 7}, "'colour' should be a valid string; expected "),
        ("render", {"colour": "vermilion"}, "'colour' should have at most 5 characters"),
        ("render", b'{"colour": "\\ud800"}', "'colour' should be a valid string"),
        ("wash", {"id": 7}, "'id' should be a valid string"),
        ("wash", {"id": ""}, "'id' should have at least 1 character"),
        ("wash", b" " * 65_537, "a request of 65537 bytes; at most 65536 are read"),
    ],
)
def test_what_cannot_be_done_is_reported_in_words(
    workshop: Workshop, verb: str, request_: object, words: str
):
    facts = workshop.ask(verb, request_)
    assert words in facts["error"]
    assert workshop.begun == []
    assert workshop.dispatcher.counts() == {"refused": 1}


def test_the_same_id_gives_the_same_answer_and_is_done_once(workshop: Workshop):
    first = workshop.ask("render", {"colour": "red", "id": "7"})
    workshop.now_s = REMEMBER_S
    assert workshop.ask("render", {"id": "7", "colour": "red"}) == first
    assert len(workshop.begun) == 1
    workshop.now_s = REMEMBER_S + 0.001
    assert workshop.ask("render", {"colour": "red", "id": "7"})["number"] == 2


def test_an_id_does_not_serve_for_another_command(workshop: Workshop):
    workshop.ask("render", {"colour": "red", "id": "7"})
    workshop.now_s = 12.0
    for verb, request in (("render", {"colour": "blue", "id": "7"}), ("wash", {"id": "7"})):
        facts = workshop.ask(verb, request)
        assert facts["error"].startswith("the id '7' was taken 12 s ago by render, with other content")
    assert len(workshop.begun) == 1


def test_a_refused_command_leaves_its_id_free(workshop: Workshop):
    workshop.refuses = "32 commands wait"
    assert workshop.ask("wash", {"id": "7"}) == {"ok": False, "id": "7", "error": "32 commands wait"}
    workshop.refuses = ""
    assert workshop.ask("wash", {"id": "7"})["ok"]


def test_ids_do_not_pile_up_without_end(workshop: Workshop, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(commands, "REMEMBER_MOST", 3)
    for k in range(4):
        workshop.ask("wash", {"id": str(k)})
    assert workshop.ask("wash", {"id": "3"})["number"] == 4
    assert workshop.ask("wash", {"id": "0"})["number"] == 5


def test_what_takes_too_long_is_reported_and_its_end_can_be_asked_for(workshop: Workshop):
    workshop.settles = False
    facts = workshop.ask("wash", {"id": "7"})
    assert facts["error"].startswith("taken up, but not finished within 0.05 s")
    workshop.outcomes[0].failed("no water")
    assert workshop.ask("wash", {"id": "7"}) == {"ok": False, "id": "7", "error": "no water"}
    assert len(workshop.begun) == 1


def test_two_who_ask_at_once_with_one_id_share_one_outcome():
    begun: queue.SimpleQueue[Outcome] = queue.SimpleQueue()

    def start(request: Request, outcome: Outcome) -> None:
        begun.put(outcome)

    dispatcher = CommandDispatcher({"wash": Verb(Request, start)})
    asking = [started(partial(dispatcher.answer, "wash", b'{"id": "7"}')) for _ in range(2)]
    begun.get(timeout=5.0).done(number=1)
    answers = [json.loads(requested.result(10.0).body) for requested in asking]
    assert answers == [{"ok": True, "id": "7", "number": 1}] * 2
    assert dispatcher.counts() == {"wash": 1}


def test_a_command_whose_begin_waits_for_a_disk_holds_up_neither_health_nor_another():
    reads, release = threading.Event(), threading.Event()

    def start_slowly(request: Request, outcome: Outcome) -> None:
        reads.set()
        assert release.wait(10.0)
        raise CommandError("no such map")

    verbs = {"load": Verb(Request, start_slowly), "wash": Verb(Request, lambda _, outcome: outcome.done())}
    dispatcher = CommandDispatcher(verbs, answer_timeout_s=5.0)

    def ask(verb: str, payload: bytes) -> Future[dict[str, object]]:
        return started(lambda: json.loads(dispatcher.answer(verb, payload).body))

    slow = ask("load", b'{"id": "7"}')
    assert reads.wait(5.0)
    assert ask("wash", b"").result(5.0) == {"ok": True}
    assert started(dispatcher.counts).result(5.0) == {"wash": 1}
    same = ask("load", b'{"id": "7"}')
    release.set()
    refused = {"ok": False, "id": "7", "error": "no such map"}
    assert [slow.result(10.0), same.result(10.0)] == [refused, refused]
    assert dispatcher.counts() == {"wash": 1, "refused": 2}
