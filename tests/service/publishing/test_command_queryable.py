import logging
import threading
from functools import partial

import pytest
import zenoh

from service.publishing import command_queryable, query_workers
from service.publishing.zenoh_publisher import ZenohPublisher
from tests.in_background import started
from tests.service.publishing.conftest import Asked

ROOT = "corridor/v1/veh1"


def ask(session: zenoh.Session, key: str, payload: str | None = None) -> list[tuple[bool, str, str]]:
    """Replies as (good, encoding, text)."""
    facts = []
    for reply in session.get(f"{ROOT}/{key}", payload=payload, timeout=10.0):
        sample = reply.ok if reply.ok is not None else reply.err
        facts.append((reply.ok is not None, str(sample.encoding), sample.payload.to_string()))
    return facts


def test_verb_and_payload_go_in_and_json_comes_out(
    served: ZenohPublisher, client: zenoh.Session, requested: Asked
):
    assert ask(client, "cmd/mark", '{"text": "bump"}') == [(True, "application/json", '{"ok": true}')]
    assert ask(client, "cmd/refuse") == [(False, "application/json", '{"ok": false, "error": "no"}')]
    assert requested.heard == [("mark", b'{"text": "bump"}'), ("refuse", b"")]


def test_what_was_asked_and_what_came_of_it_is_in_the_log(
    served: ZenohPublisher, client: zenoh.Session, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.INFO, command_queryable.log.name)
    ask(client, "cmd/mark", '{"text": "bump\n"}')
    ask(client, "cmd/refuse", "x" * 1000)
    served.close()
    assert [record.getMessage() for record in caplog.records] == [
        r"""command 'mark' '{"text": "bump\n"}': '{"ok": true}'""",
        f"""command 'refuse' '{"x" * 300}'...: '{{"ok": false, "error": "no"}}'""",
    ]


def test_a_command_for_which_there_is_no_thread_is_refused_and_the_next_is_done(
    served: ZenohPublisher, client: zenoh.Session, monkeypatch: pytest.MonkeyPatch
):
    def start(self: threading.Thread) -> None:
        if self.name == "zenoh-command":
            raise RuntimeError("can't start new thread")
        begin(self)

    begin = threading.Thread.start
    monkeypatch.setattr(query_workers, "MAX_AT_ONCE", 1)
    with monkeypatch.context() as exhausted:
        exhausted.setattr(threading.Thread, "start", start)
        ((good, _, text),) = ask(client, "cmd/mark")
    assert not good
    assert "no thread for it: can't start new thread; ask again" in text
    assert ask(client, "cmd/mark")[0][0]


def test_commands_that_are_not_done_when_the_session_closes_are_in_the_log(
    publisher: ZenohPublisher,
    client: zenoh.Session,
    requested: Asked,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    monkeypatch.setattr(query_workers, "CLOSE_TIMEOUT_S", 0.05)
    publisher.answer_commands(requested)
    requested.go.clear()
    asking = [started(partial(ask, client, f"cmd/{verb}")) for verb in ("mark", "pause")]
    for _ in asking:
        assert requested.entered.acquire(timeout=10.0)
    answering = [thread for thread in threading.enumerate() if thread.name == "zenoh-command"]
    publisher.close()
    facts = [record.getMessage() for record in caplog.records]
    requested.go.set()
    for asker in asking:
        asker.result(20.0)
    for thread in answering:
        thread.join(20.0)
    assert sorted(facts) == [
        f"command '{verb}' is not done after 0 s; who asked hears no answer" for verb in ("mark", "pause")
    ]
