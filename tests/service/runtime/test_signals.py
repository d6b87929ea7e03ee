import os
import signal
import time
from collections.abc import Iterator

import pytest

from service.runtime.signals import STOP_SIGNALS, StopSignals
from tests.in_background import started


@pytest.fixture(autouse=True)
def handlers_of_before() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_the_first_stop_signal_is_what_counts():
    with StopSignals() as signals:
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.wait(5.0) == "SIGTERM"
        os.kill(os.getpid(), signal.SIGINT)
        assert signals.wait(5.0) == "SIGTERM"


def test_another_thread_can_wake_the_wait():
    with StopSignals() as signals:
        began_s = time.monotonic()
        waking = started(signals.wake)
        assert signals.wait(30.0) == ""
        assert time.monotonic() - began_s < 20.0
        waking.result(10.0)


def test_where_one_came_more_of_them_are_ignored_to_the_end_of_the_process():
    with StopSignals() as signals:
        os.kill(os.getpid(), signal.SIGINT)
        assert signals.wait(5.0) == "SIGINT"
    for number in STOP_SIGNALS:
        assert signal.getsignal(number) == signal.SIG_IGN
        os.kill(os.getpid(), number)
