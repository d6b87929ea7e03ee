import queue
import threading

import pytest
import zenoh

from drivers.zenoh_callback import MAX_WAITING, daemon_callback
from drivers.zenoh_config import zenoh_config
from tests.in_background import started
from tests.waiting import wait_until


def test_samples_are_taken_in_order_in_a_daemon_that_ends_with_the_subscriber(
    caplog: pytest.LogCaptureFixture,
):
    heard: queue.SimpleQueue[tuple[bytes, threading.Thread]] = queue.SimpleQueue()
    wanted = [str(number).encode() for number in range(600)]
    go_on, sent = threading.Event(), []

    def take(sample: zenoh.Sample) -> None:
        go_on.wait(20.0)
        heard.put((sample.payload.to_bytes(), threading.current_thread()))
        if sample.payload.to_bytes() == b"0":
            raise ValueError("no such sample")

    def send() -> None:
        for payload in wanted:
            session.put("scan", payload)
            sent.append(payload)

    session = zenoh.open(zenoh_config({"mode": "peer", "listen/endpoints": ["tcp/127.0.0.1:0"]}))
    try:
        subscriber = session.declare_subscriber("scan", daemon_callback(take, "scans"))
        sending = started(send)
        wait_until(lambda: len(sent) > MAX_WAITING)
        assert len(sent) == MAX_WAITING + 1  # one is being taken; who sends the next waits
        go_on.set()
        taken = [heard.get(timeout=20.0) for _ in wanted]
        assert [payload for payload, _ in taken] == wanted
        (thread,) = {thread for _, thread in taken}
        assert (thread.name, thread.daemon) == ("scans", True)
        sending.result(20.0)
        subscriber.undeclare()
        thread.join(20.0)
        assert not thread.is_alive()
    finally:
        session.close()
    (record,) = caplog.records
    assert (record.levelname, record.getMessage()) == ("ERROR", "scans")
    assert "ValueError: no such sample" in caplog.text
