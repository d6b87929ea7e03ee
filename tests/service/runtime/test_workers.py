import threading

import pytest

from service.runtime.workers import Workers


def test_a_thread_that_does_not_end_is_reported_and_left(caplog: pytest.LogCaptureFixture):
    release = threading.Event()
    workers = Workers(lambda: None)
    thread = workers.start("stuck", lambda: release.wait(30.0) and None)
    assert not workers.join(thread, 0.01)
    assert "thread stuck did not end" in caplog.text
    release.set()
    assert workers.join(thread, 5.0)
