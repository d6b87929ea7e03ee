import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from service.runtime.notify import Notifier


@contextmanager
def systemd(name: str) -> Iterator[socket.socket]:
    """A listening notify socket; name: what stands in NOTIFY_SOCKET for it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind("\0" + name[1:] if name.startswith("@") else name)
        listener.settimeout(5.0)
        yield listener


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "notify")


@pytest.mark.parametrize("is_abstract", [False, True])
def test_words_reach_systemd(path: str, is_abstract: bool):
    name = f"@corridor-test-{os.getpid()}" if is_abstract else path
    with systemd(name) as listener:
        notifier = Notifier({"NOTIFY_SOCKET": name})
        notifier.ready()
        notifier.alive()
        notifier.status("mapping, 2/2 sensors")
        notifier.need_more_time(30.0)
        notifier.stopping()
        words = [listener.recv(256).decode() for _ in range(5)]
        notifier.close()
    assert words == [
        "READY=1",
        "WATCHDOG=1",
        "STATUS=mapping, 2/2 sensors",
        "EXTEND_TIMEOUT_USEC=30000000",
        "STOPPING=1",
    ]


def test_a_listener_that_goes_away_does_not_stop_us(path: str, caplog: pytest.LogCaptureFixture):
    with systemd(path):
        notifier = Notifier({"NOTIFY_SOCKET": path})
    caplog.set_level(logging.WARNING)
    notifier.ready()
    notifier.ready()
    assert caplog.text.count("cannot notify systemd at") == 1
    assert caplog.text.count("nothing receives") == 0


def test_a_listener_that_comes_back_hears_the_watchdog_again(path: str):
    """Else it would kill a service that is well."""
    with systemd(path):
        notifier = Notifier({"NOTIFY_SOCKET": path})
    notifier.alive()
    os.unlink(path)
    notifier.alive()
    with systemd(path) as listener:
        notifier.alive()
        assert listener.recv(256) == b"WATCHDOG=1"
        notifier.close()
        notifier.alive()
        listener.setblocking(False)
        with pytest.raises(BlockingIOError):
            listener.recv(256)


def test_a_listener_that_sleeps_does_not_hold_us_up(path: str, caplog: pytest.LogCaptureFixture):
    with systemd(path) as listener:
        notifier = Notifier({"NOTIFY_SOCKET": path})
        for _ in range(100_000):
            notifier.alive()
            if caplog.text:
                break
        assert "systemd does not take WATCHDOG=1" in caplog.text
        listener.recv(256)
        notifier.ready()  # and we still talk to it
        while (word := listener.recv(256)) == b"WATCHDOG=1":
            pass
        assert word == b"READY=1"
        notifier.close()


@pytest.mark.parametrize(
    ("environment", "watchdog_s"),
    [
        ({"WATCHDOG_USEC": "10000000"}, 5.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, 5.0),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_the_watchdog_is_fed_twice_as_often_as_needed(environment: dict[str, str], watchdog_s: float | None):
    assert Notifier(environment).watchdog_s == watchdog_s
