import socket as sockets
from contextlib import ExitStack
from dataclasses import dataclass
from select import select

import pytest

from service.web import connections
from service.web.connections import Seats
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
    """Whether the service has not closed it by now; reads what it sent."""
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


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost:"])
def test_whoever_sends_no_whole_request_is_disconnected_and_a_browser_stays(serve, monkeypatch, sent):
    monkeypatch.setattr(connections, "IDLE_S", IDLE_S)
    server = serve()

    async def look(client):
        async with client.socket() as socket:
            await client.next(socket, "hello")
            with connect(server) as idle:
                idle.sendall(sent)
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
        with connect(server) as other:
            other.sendall(sent + b"\r\n\r\n")
            while not is_closed(other):
                pass
    assert server.health().values["refused"] == "2"  # the other speaks TLS, say, and is nothing of note
    assert caplog.records == []


@dataclass(eq=False)
class Somebody:
    address: str = "10.0.0.9"
    is_guest: bool = True
    must_show: bool = False


def fill(seats: Seats, addresses: list[str]) -> list[Somebody]:
    """Guests that come one after the other; whoever has to, leaves."""
    seated: list[Somebody] = []
    for address in addresses:
        if not seats.has_place(seated):
            seated.remove(seats.to_leave(seated))
        seated.append(Somebody(address, must_show=seats.must_show(seated, address)))
    return seated


def test_a_quarter_of_the_places_is_for_those_who_show_a_token():
    seated = fill(Seats(32), [f"10.0.0.{number}" for number in range(32)])
    assert [one.must_show for one in seated] == [False] * 24 + [True] * 8


@pytest.mark.parametrize(("address", "stay"), [("10.0.0.9", 8), ("127.0.0.1", 24), ("::1", 24), ("", 8)])
def test_one_address_has_a_third_of_the_others_places_but_this_machine_all(address, stay):
    seated = fill(Seats(32), [address] * 20 + [address] * 12)
    assert sum(not one.must_show for one in seated) == stay


def test_a_crowd_of_one_address_does_not_keep_newcomers_out_and_loses_its_own_oldest():
    seats = Seats(32)
    seated = fill(seats, ["10.0.0.7", *["10.0.0.9"] * 500])
    assert len(seated) == 32
    assert seated[0].address == "10.0.0.7"
    leaving = seats.to_leave(seated)
    assert leaving is next(one for one in seated if one.must_show)
    assert leaving.address == "10.0.0.9"


def test_guests_leave_for_newcomers_and_those_with_a_token_never():
    seats = Seats(4)
    owners = [Somebody(is_guest=False) for _ in range(3)]
    guest = Somebody()
    assert seats.to_leave([*owners, guest]) is guest
    assert seats.to_leave(owners) is None
