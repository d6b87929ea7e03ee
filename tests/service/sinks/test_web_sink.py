from datetime import UTC, datetime, timedelta

import pytest

from service.encoding import OK, WARNING
from service.offline.security.authority import Holder, init_site
from service.publishing.commands import Answer
from service.sinks.web_sink import open_sink
from service.web.config import WebConfig
from tests.browser.scene import Scene, stamp
from tests.service.sinks.contexts import sink_context
from tests.service.web.conftest import TIMEOUT_S, Client, talk


@pytest.fixture
def open_page(tmp_path):
    """Opens a sink on any free port, its token in the file that is given."""
    opened = []

    def open_one(token_file=tmp_path / "web.token", settings=None, **context):
        config = WebConfig(listen="127.0.0.1:0", token_file=token_file, **(settings or {}))
        sink = open_sink(config, sink_context(**context))
        opened.append(sink)
        assert sink.server.wait_served(TIMEOUT_S)
        return sink

    yield open_one
    for sink in opened:
        sink.close()


async def ask(client: Client, token: str) -> dict:
    async with client.socket() as socket:
        await client.ask(socket, type="token", token=token)
        await client.ask(socket, type="command", n=1, verb="mark", request={"text": "x"})
        return (await client.next(socket, "answer"))["body"]


def ask_at(sink, token):
    answers = []

    async def conversation(client):
        answers.append(await ask(client, token))

    talk(sink.server, conversation)
    return answers[0]


def test_what_is_put_is_shown_before_the_start_too(open_page):
    sink = open_page()

    async def look(client):
        async with client.socket() as socket:
            hello = await client.next(socket, "hello")
            assert (hello["vehicle"], hello["profile"], hello["verbs"]) == ("veh1", "corridor", [])
            for message in Scene().messages(1.0):
                sink.put(message)
            assert (await client.next(socket, "pose"))["stamp_ns"] == str(stamp(1.0))
            assert (await client.next(socket, "health"))["statuses"]
            sink.start()
            assert (await client.next(socket, "verbs"))["verbs"] == ["mark"]

    talk(sink.server, look)
    assert sink.place() == sink.server.address != ""


def test_commands_reach_the_service_from_the_start_on_with_the_token_of_the_file(open_page, tmp_path):
    requested = []

    def command(verb, payload):
        requested.append((verb, payload))
        return Answer(True, b'{"ok": true}')

    sink = open_page(command=command)
    token = (tmp_path / "web.token").read_text().strip()
    assert "still starting" in ask_at(sink, token)["error"]
    assert requested == []
    sink.start()
    assert ask_at(sink, token) == {"ok": True}
    assert requested == [("mark", b'{"text": "x"}')]
    assert not ask_at(sink, "another")["ok"]


def test_the_token_lies_in_the_folder_of_state(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    open_sink(WebConfig(listen="127.0.0.1:0"), sink_context()).close()
    assert (tmp_path / "xdg" / "corridor" / "web.token").is_file()
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path / 'state'}:{tmp_path / 'other'}")
    open_sink(WebConfig(listen="127.0.0.1:0"), sink_context()).close()
    assert (tmp_path / "state" / "web.token").is_file()


@pytest.mark.parametrize("days", [30, 90])
def test_a_certificate_that_has_expired_is_a_warning_for_no_browser_says_it_here(open_page, tmp_path, days):
    init_site(tmp_path, [Holder("veh1", "vehicle", ())], days, now=datetime.now(UTC) - timedelta(days=40))
    sink = open_page(settings={"tls_certificate": tmp_path / "veh1.pem", "tls_key": tmp_path / "veh1.key"})
    row = sink.health()
    assert row.level == (WARNING if days == 30 else OK)
    assert ("veh1.pem is valid from" in row.message) == (days == 30)
