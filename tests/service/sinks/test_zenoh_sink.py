from collections.abc import Callable, Iterator

import pytest
import zenoh

from drivers.link import LinkHealth
from service.encoding import OK, STRING, WARNING, Message, Status, encode_diagnostics
from service.publishing.config import PublishingConfig
from service.sinks.zenoh_sink import ZenohSink
from tests.service.publishing.conftest import Inbox, client_config
from tests.service.sinks.contexts import sink_context
from tests.service.web.conftest import repeating

ROOT = "corridor/v1/veh1"


@pytest.fixture
def link() -> LinkHealth:
    return LinkHealth("front")


@pytest.fixture
def sink(link: LinkHealth) -> Iterator[ZenohSink]:
    config = PublishingConfig(listen=("tcp/127.0.0.1:0",))
    opened = ZenohSink(config, sink_context(links={"front": link}))
    opened.start()
    yield opened
    opened.close()


@pytest.fixture
def client(sink: ZenohSink) -> Iterator[zenoh.Session]:
    with zenoh.open(client_config(sink.place())) as session:
        yield session


def put_until_heard(put: Callable[[], None], inbox: Inbox) -> list[zenoh.Sample]:
    """A subscription takes a moment to come to the sender: what is put before that goes nowhere."""
    with repeating(put, 0.05):
        return inbox.wait_for(1)


def test_only_what_subscribers_have_use_for_goes_out(sink: ZenohSink, client: zenoh.Session):
    inbox = Inbox()
    subscriber = client.declare_subscriber(f"{ROOT}/**", inbox)

    def put_all() -> None:
        for channel in ("events", "front/raw", "map", "front/scan"):
            sink.put(Message(channel, STRING, 1, 1, b"\0\1\0\0"))

    heard = put_until_heard(put_all, inbox)
    assert {str(sample.key_expr) for sample in heard} == {f"{ROOT}/front/scan"}
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    sink.close()  # after that nothing is counted any more
    assert [key for key in sink.health().values if key.startswith("sent.")] == ["sent.front/scan"]


def test_service_and_mapping_have_tokens_while_they_work(sink: ZenohSink, client: zenoh.Session):
    tokens = Inbox()
    watcher = client.liveliness().declare_subscriber(f"{ROOT}/alive/*", tokens, history=True)
    heard = []
    for number, state in enumerate(("waiting", "lost", "stale"), start=1):
        row = Status("mapping", OK, "", {"state": state})
        sink.put(encode_diagnostics("diagnostics", [row], 1, 1))
        heard = tokens.wait_for(number)
    facts = [(str(token.key_expr).removeprefix(f"{ROOT}/alive/"), token.kind) for token in heard]
    put, delete = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE
    assert facts == [("service", put), ("mapping", put), ("mapping", delete)]
    watcher.undeclare()  # type: ignore[no-untyped-call]


def test_diagnostics_are_called_health_and_bring_the_tokens_of_sensors_up_to_date(
    sink: ZenohSink, client: zenoh.Session, link: LinkHealth
):
    health, tokens = Inbox(), Inbox()
    subscriber = client.declare_subscriber(f"{ROOT}/health", health)
    watcher = client.liveliness().declare_subscriber(f"{ROOT}/alive/front", tokens, history=True)
    rows = encode_diagnostics("diagnostics", [Status("x", OK, "", {})], 1, 1)
    link.state = "streaming"
    heard = put_until_heard(lambda: sink.put(rows), health)
    assert heard[0].payload.to_bytes() == rows.payload
    token = tokens.wait_for(1)[0]
    assert (str(token.key_expr), token.kind) == (f"{ROOT}/alive/front", zenoh.SampleKind.PUT)
    link.state = "down"
    sink.put(rows)
    assert tokens.wait_for(2)[1].kind == zenoh.SampleKind.DELETE
    for declared in (subscriber, watcher):
        declared.undeclare()  # type: ignore[no-untyped-call]


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
    assert row.values["reason_id"] == "messages_dropped"
