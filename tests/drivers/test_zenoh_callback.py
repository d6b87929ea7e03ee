import queue
import threading

import pytest
import zenoh

from drivers.zenoh_callback import daemon_callback
from drivers.zenoh_config import zenoh_config


def test_samples_are_taken_in_order_in_a_daemon_that_ends_with_the_subscriber(
    caplog: pytest.LogCaptureFixture,
):
    heard: queue.SimpleQueue[tuple[bytes, threading.Thread]] = queue.SimpleQueue()

    def take(sample: zenoh.Sample) -> None:
        heard.put((sample.payload.to_bytes(), threading.current_thread()))
        if sample.payload.to_bytes() == b"0":
            raise ValueError("no such sample")

    session = zenoh.open(zenoh_config({"mode": "peer", "listen/endpoints": ["tcp/127.0.0.1:0"]}))
    try:
        subscriber = session.declare_subscriber("scan", daemon_callback(take, "scans"))
        for number in range(600):  # more than may wait
            session.put("scan", str(number).encode())
        taken = [heard.get(timeout=20.0) for _ in range(600)]
        assert [payload for payload, _ in taken] == [str(number).encode() for number in range(600)]
        (thread,) = {thread for _, thread in taken}
        assert (thread.name, thread.daemon) == ("scans", True)
        subscriber.undeclare()
        thread.join(20.0)
        assert not thread.is_alive()
    finally:
        session.close()
    (record,) = caplog.records
    assert (record.levelname, record.getMessage()) == ("ERROR", "scans")
    assert "ValueError: no such sample" in caplog.text
