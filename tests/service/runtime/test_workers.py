import threading

import pytest

from service.runtime.readers import Workers


def test_a_failing_thread_is_reported_at_once_and_named(caplog: pytest.LogCaptureFixture):
    facts = threading.Event()
    workers = Workers(facts.set)
    thread = workers.start("mapping", lambda: [][0])
    assert facts.wait(5.0)
    assert workers.join(thread, 5.0)
    assert workers.failure == "mapping: IndexError: list index out of range"
    assert "Traceback" in caplog.text


def test_only_the_first_failure_counts():
    workers = Workers(lambda: None)
    workers.fail("first", ValueError("cause"))
    workers.fail("second", ValueError("effect"))
    assert workers.failure == "first: ValueError: cause"


def test_a_thread_that_ends_by_itself_is_no_failure():
    workers = Workers(lambda: None)
    assert workers.join(workers.start("short", lambda: None), 5.0)
    assert workers.failure == ""


def test_a_thread_that_does_not_end_is_reported_and_left(caplog: pytest.LogCaptureFixture):
    release = threading.Event()
    workers = Workers(lambda: None)
    thread = workers.start("stuck", lambda: release.wait(30.0) and None)
    assert not workers.join(thread, 0.01)
    assert "thread stuck did not end" in caplog.text
    release.set()
    assert workers.join(thread, 5.0)


def test_even_an_exit_is_a_failure():
    workers = Workers(lambda: None)

    def leave() -> None:
        raise SystemExit(0)

    assert workers.join(workers.start("leaver", leave), 5.0)
    assert workers.failure == "leaver: SystemExit: 0"
