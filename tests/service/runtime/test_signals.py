import os
import signal
import threading
import time

from service.runtime.signals import StopSignals


def test_the_first_stop_signal_is_what_counts():
    with StopSignals() as signals:
        os.kill(os.getpid(), signal.SIGTERM)
        assert signals.wait(5.0) == "SIGTERM"
        os.kill(os.getpid(), signal.SIGINT)
        assert signals.wait(5.0) == "SIGTERM"


def test_without_a_signal_the_wait_ends_by_itself():
    with StopSignals() as signals:
        assert signals.wait(0.001) == ""


def test_another_thread_can_wake_the_wait():
    with StopSignals() as signals:
        waker = threading.Thread(target=signals.wake)
        began_s = time.monotonic()
        waker.start()
        assert signals.wait(30.0) == ""
        assert time.monotonic() - began_s < 20.0
        waker.join()


def test_the_handlers_of_before_come_back():
    before = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)]
    with StopSignals():
        assert signal.getsignal(signal.SIGTERM) != before[0]
    assert [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)] == before


def test_waking_nobody_is_harmless():
    with StopSignals() as signals:
        pass
    signals.wake()
