"""Load by unknown clients while known ones are served, in short."""

import time

import pytest

from service.publishing.commands import CommandDispatcher, Outcome, Request, Verb
from service.publishing.config import PublishingConfig
from service.publishing.query_workers import MAX_AT_ONCE
from service.publishing.session import MAX_UNKNOWN
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


def test_a_flood_of_commands_is_refused_at_once_and_others_are_served(service, endpoints, open_client):
    def hang(request: Request, outcome: Outcome) -> None:
        pass  # it waits for its answer until it is too late

    dispatcher = CommandDispatcher({"mark": Verb(Request, hang)}, answer_timeout_s=SERVED_S)
    service.answer_commands(dispatcher.answer)
    flood, operator = open_client(endpoints["tcp"]), open_client(endpoints["tcp"])
    requested = [flood.get(f"{ROOT}/cmd/mark", timeout=20.0) for _ in range(200)]
    began_s = time.monotonic()
    assert answers(operator, f"{ROOT}/health")
    assert time.monotonic() - began_s < SERVED_S
    refused = [reply.err.payload.to_string() for replies in requested for reply in replies]
    assert len(refused) == 200
    at_once = sum("being worked on" in words or "come faster" in words for words in refused)
    assert at_once >= 200 - 2 * MAX_AT_ONCE


@pytest.mark.parametrize("since", ["9" * 5000, "9" * 20, "-1", "\u0663"])
def test_a_version_that_is_none_is_refused_and_health_stays(service, endpoints, open_client, since):
    session = open_client(endpoints["tcp"])
    (reply,) = session.get(f"{ROOT}/map/tile/**?since={since}", timeout=20.0)
    assert reply.err.payload.to_string().startswith(f"since={since[:19]}: expected a version")
    assert not service.counts()["failed"]
    assert list(session.get(f"{ROOT}/map/tile/**?since={'9' * 19}", timeout=20.0)) == []
