import socket as sockets
from contextlib import ExitStack
from select import select

import pytest

from service.web import connections
from tests.service.web.conftest import TIMEOUT_S, TOKEN, talk

IDLE_S = 0.3


def connect(server):
    host, _, port = server.address.removeprefix("http://").rstrip("/").partition(":")
    opened = sockets.create_connection((host, int(port)), TIMEOUT_S)
    opened.settimeout(TIMEOUT_S)
    return opened


def is_closed(connection):
    """Whether the service closes it, in time, before it says something."""
    try:
        return connection.recv(65_536) == b""
    except ConnectionResetError:
        return True


@pytest.fixture
def narrow(serve, monkeypatch):
    """A page with room for two connections."""
    monkeypatch.setattr(connections, "MIN_CONNECTIONS", 2)
    monkeypatch.setattr(connections, "CONNECTIONS_A_BROWSER", 2)
    return serve(most_browsers=1)


def get_icon(connection):
    connection.sendall(b"GET /icon.svg HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    assert connection.recv(12) == b"HTTP/1.1 200"


def is_open(connection):
    """Whether the service has not closed it by now; reads what it said."""
    connection.setblocking(False)
    try:
        while connection.recv(65_536):
            pass
    except BlockingIOError:
        return True
    except ConnectionError:
        pass
    return False


def test_a_connection_too_many_takes_the_place_of_the_oldest_that_is_no_websocket(narrow):
    async def look(client):
        async with client.socket() as socket:
            await client.next(socket, "hello")
            with connect(narrow) as second:
                get_icon(second)  # which is in when it is answered
                with connect(narrow) as third:
                    get_icon(third)
                    while is_open(second):
                        assert select([second], [], [], TIMEOUT_S)[0]
                assert narrow.health().values["refused"] == "1"
            await client.ask(socket, type="token", token=TOKEN)
            assert (await client.next(socket, "access"))["may_control"]

    talk(narrow, look)


def test_of_connections_that_come_all_at_once_few_stay(narrow):
    with ExitStack() as stack:
        crowd = [stack.enter_context(connect(narrow)) for _ in range(100)]
        while sum(map(is_open, crowd)) > 2 + connections.AT_ONCE:
            assert select([one for one in crowd if is_open(one)], [], [], TIMEOUT_S)[0]


@pytest.mark.parametrize("said", [b"", b"GET / HTTP/1.1\r\nHost:"])
def test_whoever_sends_no_whole_request_is_disconnected_and_a_browser_stays(serve, monkeypatch, said):
    monkeypatch.setattr(connections, "IDLE_S", IDLE_S)
    server = serve()

    async def look(client):
        async with client.socket() as socket:
            await client.next(socket, "hello")
            with connect(server) as idle:
                idle.sendall(said)
                assert is_closed(idle)
            await client.ask(socket, type="token", token=TOKEN)  # it has been open for longer
            assert (await client.next(socket, "access"))["may_control"]

    talk(server, look)


def test_what_is_no_http_is_let_go_and_fills_no_log(serve, caplog):
    server = serve()
    for sent in (
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"y" * 10_000,
        b"\x16\x03\x01" + b"\xff" * 500,
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Encoding: gzip\r\nContent-Length: 9\r\n\r\nxxxxx",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nabcdefghij\r\nzz",
    ):
        with connect(server) as stranger:
            stranger.sendall(sent + b"\r\n\r\n")
            while not is_closed(stranger):
                pass
    assert server.health().values["refused"] == "2"  # the other speaks TLS, say, and is nothing of note
    assert caplog.records == []
