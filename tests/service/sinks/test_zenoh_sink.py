from collections.abc import Iterator

import pytest
import zenoh

from drivers.link import LinkHealth
from service.encoding import OK, STRING, WARNING, Message
from service.mapstore.tiles import TileStore
from service.publishing.commands import Answer
from service.publishing.config import PublishingConfig
from service.sinks.zenoh_sink import ZenohSink
from tests.service.publishing.conftest import client_config
from tests.service.sinks.contexts import sink_context

ROOT = "corridor/v1/veh1"


@pytest.fixture
def link() -> LinkHealth:
    return LinkHealth("front")


@pytest.fixture
def store() -> TileStore:
    return TileStore()


@pytest.fixture
def sink(link: LinkHealth, store: TileStore) -> Iterator[ZenohSink]:
    context = sink_context(
        links={"front": link},
        tiles=store,
        command=lambda verb, payload: Answer(True, b'{"did": "' + verb.encode() + b'"}'),
    )
    opened = ZenohSink(PublishingConfig(listen=("tcp/127.0.0.1:0",)), context)
    opened.start()
    yield opened
    opened.close()


@pytest.fixture
def client(sink: ZenohSink) -> Iterator[zenoh.Session]:
    with zenoh.open(client_config(sink.place())) as session:
        yield session


def test_what_was_dropped_is_a_warning(sink: ZenohSink):
    assert sink.health().level == OK
    sink.close()
    sink.put(Message("front/scan", STRING, 1, 1, b"\0\1\0\0"))
    row = sink.health()
    assert (row.level, row.message) == (
        WARNING,
        "1 dropped, 0 failed (expected none); is the network too slow?",
    )
    assert row.values["dropped.front/scan"] == "1"
