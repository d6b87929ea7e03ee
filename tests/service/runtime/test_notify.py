import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.runtime.notify import Notifier


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """A listening notify socket and what stands in NOTIFY_SOCKET for it."""
    name = f"@corridor-test-{os.getpid()}" if request.param == "abstract" else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind("\0" + name[1:] if name.startswith("@") else name)
        listener.settimeout(5.0)
        yield listener, name


def test_words_reach_systemd(systemd: tuple[socket.socket, str]):
    listener, name = systemd
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


def test_a_listener_that_goes_away_does_not_stop_us(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
    caplog.set_level(logging.WARNING)
    notifier.ready()
    notifier.ready()
    assert caplog.text.count("cannot notify systemd at") == 1
    assert caplog.text.count("nothing receives") == 0


def test_a_listener_that_comes_back_hears_the_watchdog_again(tmp_path: Path):
    """Else it would kill a service that is well."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        notifier = Notifier({"NOTIFY_SOCKET": str(path)})
    notifier.alive()
    path.unlink()
    notifier.alive()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        listener.settimeout(5.0)
        notifier.alive()
        assert listener.recv(256) == b"WATCHDOG=1"
        notifier.close()
        notifier.alive()
        listener.setblocking(False)
        with pytest.raises(BlockingIOError):
            listener.recv(256)


def test_a_listener_that_sleeps_does_not_hold_us_up(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(tmp_path / "notify"))
        notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify")})
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
