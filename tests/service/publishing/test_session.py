"""What strangers may take up, while those who are known are served: in small, as `make test` has the time."""

import socket
import time
from contextlib import ExitStack

import pytest

from service.publishing.commands import CommandDispatcher, Outcome, Request, Verb
from service.publishing.config import PublishingConfig
from service.publishing.query_workers import MAX_AT_ONCE
from service.publishing.session import MAX_COMMAND_BYTES, MAX_UNKNOWN
from tests.service.publishing.conftest import tls
from tests.service.publishing.test_security import ROOT, answers, put_health

SERVED_S = 1.0
SILENT = MAX_UNKNOWN + 100


@pytest.fixture
def service(site, open_publisher):
    listen = ("tcp/127.0.0.1:0", "tls/127.0.0.1:0")
    opened = open_publisher(PublishingConfig(listen=listen, security={"tls": tls(site, "veh1")}))
    put_health(opened)
    return opened


@pytest.fixture
def endpoints(service) -> dict[str, str]:
    return {endpoint[:3]: endpoint for endpoint in service.endpoints}


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_silent_connections_do_not_keep_a_client_out(endpoints, open_client, client_of, protocol):
    host, port = endpoints[protocol].partition("/")[2].rsplit(":")
    with ExitStack() as silent:
        for _ in range(SILENT):
            silent.enter_context(socket.create_connection((host, int(port))))
        began_s = time.monotonic()
        honest = open_client(endpoints["tcp"]) if protocol == "tcp" else client_of(endpoints["tls"], "viewer")
        assert answers(honest, f"{ROOT}/health")
        assert time.monotonic() - began_s < SERVED_S


def test_a_flood_of_commands_is_refused_at_once_and_others_are_served(service, endpoints, open_client):
    def hang(request: Request, outcome: Outcome) -> None:
        pass  # it waits for its answer until it is too late

    dispatcher = CommandDispatcher({"mark": Verb(Request, hang)}, answer_timeout_s=SERVED_S)
    service.answer_commands(dispatcher.answer)
    flood, honest = open_client(endpoints["tcp"]), open_client(endpoints["tcp"])
    asked = [flood.get(f"{ROOT}/cmd/mark", timeout=20.0) for _ in range(200)]
    began_s = time.monotonic()
    assert answers(honest, f"{ROOT}/health")
    assert time.monotonic() - began_s < SERVED_S
    refused = [reply.err.payload.to_string() for replies in asked for reply in replies]
    assert len(refused) == 200
    at_once = sum("being worked on" in words or "come faster" in words for words in refused)
    assert at_once >= 200 - 2 * MAX_AT_ONCE


def test_an_oversized_command_is_dropped_and_the_next_is_answered(service, endpoints, open_client):
    asked: list[int] = []
    service.answer_commands(lambda verb, payload: asked.append(len(payload)) or hello)
    hello = CommandDispatcher({}).answer("x", b"")
    session = open_client(endpoints["tcp"])
    for size in (MAX_COMMAND_BYTES + 1, 70_000, 3):
        list(session.get(f"{ROOT}/cmd/mark", payload=bytes(size), timeout=20.0))
    assert asked == [70_000, 3]


@pytest.mark.parametrize("since", ["9" * 5000, "9" * 20, "-1", "\u0663"])
def test_a_version_that_is_none_is_refused_and_health_stays(service, endpoints, open_client, since):
    session = open_client(endpoints["tcp"])
    (reply,) = session.get(f"{ROOT}/map/tile/**?since={since}", timeout=20.0)
    assert reply.err.payload.to_string().startswith(f"since={since[:19]}: expected a version")
    assert not service.counts()["failed"]
    assert list(session.get(f"{ROOT}/map/tile/**?since={'9' * 19}", timeout=20.0)) == []
