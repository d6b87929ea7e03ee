"""Access to the page, and its limits for unknown clients."""

import contextlib
import json
import logging

import aiohttp
import pytest

from service.web import browser
from service.web.tokens import add_grant, revoke_grant
from tests.service.web.conftest import TOKEN, talk


def test_commands_need_the_token(serve, dispatcher, caplog):
    caplog.set_level(logging.INFO)

    async def ask(client):
        async with client.socket() as socket:
            await client.ask(socket, type="command", n=1, verb="mark", request={"text": "x"})
            refused = await client.next(socket, "answer")
            assert (refused["n"], refused["body"]["ok"]) == (1, False)
            assert "token" in refused["body"]["error"]
            await client.ask(socket, type="token", token="wrong")
            access = await client.next(socket, "access")
            assert (access["may_control"], access["error"]) == (
                False,
                "this is not the token of this service, or it has expired",
            )
            await client.ask(socket, type="command", n=2, verb="mark")
            assert not (await client.next(socket, "answer"))["body"]["ok"]
            assert dispatcher.requested == []
            await client.ask(socket, type="token", token=TOKEN)
            assert (await client.next(socket, "access"))["may_control"]
            await client.ask(socket, type="command", n=3, verb="mark", request={"text": "x"})
            answer = await client.next(socket, "answer")
            assert (answer["n"], answer["body"]) == (3, {"ok": True, "verb": "mark"})
        assert [(verb, json.loads(payload)) for verb, payload in dispatcher.requested] == [
            ("mark", {"text": "x"})
        ]

    talk(serve(), ask)
    done = [record.getMessage() for record in caplog.records if '"verb"' in record.getMessage()]
    assert done == [
        "web: by the service's own token at 127.0.0.1: "
        '{"verb": "mark", "request": {"text": "x"}}: {"ok": true, "verb": "mark"}'
    ]


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_another_page_cannot_open_the_socket(serve, origin):
    server = serve()

    async def open_socket(client):
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            async with client.socket(origin=origin):
                raise AssertionError("opened")
        assert refused.value.status == 403

    talk(server, open_socket)
    assert server.health().values["refused"] == "1"


@pytest.mark.parametrize("path", ["", "main.js", "ws"])
def test_a_name_that_is_not_ours_is_refused_everywhere(serve, path):
    async def look(client):
        headers = {"Host": "evil.example"}
        async with client.session.get(f"{client.address}{path}", headers=headers) as response:
            assert response.status == 403
            assert "web.hosts" in await response.text()

    talk(serve(), look)


@pytest.mark.parametrize("text", ["x" * 70_000, None])
def test_what_is_too_large_or_no_text_ends_the_talk(serve, text):
    async def ask(client):
        async with client.socket() as socket:
            await (socket.send_bytes(b"\0") if text is None else socket.send_str(text))
            code = await client.closed_with(socket)
            assert code in (aiohttp.WSCloseCode.MESSAGE_TOO_BIG, aiohttp.WSCloseCode.POLICY_VIOLATION)

    talk(serve(), ask)


def test_who_asks_too_often_is_let_go(serve):
    async def ask(client):
        async with client.socket() as socket:
            with contextlib.suppress(ConnectionResetError):  # let go before all was asked
                for number in range(round(3 * browser.ASKED_BURST)):
                    await client.ask(socket, type="command", n=number, verb="mark")
            code = await client.closed_with(socket)
            # the second where data in transit met a closed socket
            assert code in (aiohttp.WSCloseCode.POLICY_VIOLATION, aiohttp.WSCloseCode.ABNORMAL_CLOSURE)

    talk(serve(), ask)


def test_sockets_without_a_token_do_not_keep_out_one_that_has_it(serve, dispatcher):
    """32 of them, then one that shows a token, which stays while more come."""

    async def look(client):
        async with contextlib.AsyncExitStack() as crowd:
            for _ in range(32):
                await client.next(await crowd.enter_async_context(client.socket()), "hello")
            async with client.socket() as operator:
                await client.ask(operator, type="token", token=TOKEN)
                assert (await client.next(operator, "access"))["may_control"]
                for _ in range(20):
                    await client.next(await crowd.enter_async_context(client.socket()), "hello")
                await client.ask(operator, type="command", n=1, verb="mark")
                assert (await client.next(operator, "answer"))["body"]["ok"]

    server = serve(most_browsers=32)
    talk(server, look)
    assert server.health().values["refused"] == "21"
    assert [verb for verb, _ in dispatcher.requested] == ["mark"]


def test_a_viewers_token_gives_no_commands_and_a_revoked_one_no_more(serve, tmp_path, dispatcher):
    path = tmp_path / "web.tokens.json"
    anna, hall = (
        add_grant(path, name, role, None) for name, role in (("anna", "operator"), ("hall", "viewer"))
    )

    async def ask(client):
        async with client.socket() as socket:
            await client.ask(socket, type="token", token=hall)
            access = await client.next(socket, "access")
            assert (access["may_control"], access["role"], access["error"]) == (False, "viewer", "")
            await client.ask(socket, type="command", n=1, verb="mark")
            assert "token of an operator" in (await client.next(socket, "answer"))["body"]["error"]
            await client.ask(socket, type="token", token=anna)
            access = await client.next(socket, "access")
            assert (access["may_control"], access["name"]) == (True, "anna")
            revoke_grant(path, "anna")
            access = await client.next(socket, "access")
            assert (access["may_control"], access["role"]) == (False, "")
            assert access["error"] == "the token was revoked, or has expired"
            await client.ask(socket, type="command", n=2, verb="mark")
            assert not (await client.next(socket, "answer"))["body"]["ok"]

    server = serve(granted=path)
    talk(server, ask)
    assert dispatcher.requested == []
    path.chmod(0o644)

    async def guess(client):
        async with client.socket() as socket:
            await client.ask(socket, type="token", token=hall)
            assert not (await client.next(socket, "access"))["may_control"]

    talk(server, guess)
    assert server.health().level == 1
    assert server.health().values["reason_id"] == "token_unreadable"
    assert "others may read the further tokens" in server.health().message
