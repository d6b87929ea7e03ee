"""A machine whose /proc, /sys and /dev are folders, and things on real wires that no driver expects."""

import os
import select
import socket
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from service.offline.doctor import verdict
from service.offline.doctor.machine import KernelClock, Machine
from simulators.wire import TcpWire
from tests.in_background import in_background
from tests.silent_device import SilentDevice

PATIENCE_S = 60.0


@pytest.fixture
def any_rate_will_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fake devices on a busy machine come late, and that is not what is looked at."""
    monkeypatch.setattr(verdict, "RATE_SHARE", 0.0)


class FakeTree:
    """Files below a folder that stands for /."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def write(self, name: str, text: str | bytes) -> Path:
        path = self.root / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    def link(self, name: str, target: str | Path) -> Path:
        path = self.root / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(target)
        return path

    def process(self, number: int, name: str, *arguments: str, holds: str = "") -> None:
        self.write(f"/proc/{number}/comm", name + "\n")
        self.write(f"/proc/{number}/cmdline", b"\0".join(a.encode() for a in arguments) + b"\0")
        (self.root / f"proc/{number}/fd").mkdir()
        if holds:
            self.link(f"/proc/{number}/fd/7", holds)

    def machine(self, **changes: object) -> Machine:
        """A user without any special right, on a machine with a good clock and a large disk."""
        settings: dict[str, object] = {
            "root": self.root,
            "environment": {"HOME": str(self.root / "home")},
            "user": "driver",
            "group_ids": frozenset({1000}),
            "is_root": False,
            "may_read_and_write": lambda path: True,
            "free_bytes": lambda path: 100_000_000_000,
            "kernel_clock": lambda: KernelClock(True, 0.004),
            "unix_s": lambda: 1.8e9,
        }
        return Machine(**(settings | changes))  # type: ignore[arg-type]


@pytest.fixture
def tree(tmp_path: Path) -> FakeTree:
    (tmp_path / "root").mkdir()
    return FakeTree(tmp_path / "root")


class Parrot(SilentDevice):
    """A FakeDevice that says always the same to everything it hears."""

    def __init__(self, answer: bytes) -> None:
        self._answer = answer
        self.heard = bytearray()

    def receive_data(self, data: bytes, now_ns: int) -> bytes:
        self.heard += data
        return self._answer


@pytest.fixture
def on_tcp() -> Iterator[Callable[..., tuple[str, int]]]:
    """Puts fake devices on loopback ports, as long as the test runs."""
    with ExitStack() as stack:
        yield lambda device: stack.enter_context(TcpWire(device))


@pytest.fixture
def closed_port() -> int:
    with socket.socket() as door:
        door.bind(("127.0.0.1", 0))
        return int(door.getsockname()[1])


class Line:
    """A serial line that says what it likes at each baud rate; `heard` is what was written to it."""

    def __init__(self, says: Callable[[int], bytes]) -> None:
        self._says = says
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self.heard = bytearray()
        self._open = ExitStack()

    def __enter__(self) -> "Line":
        for end in (self._master, self._slave):
            self._open.callback(os.close, end)
        self._open.enter_context(in_background(self._run, PATIENCE_S))
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._open.close()

    def _run(self, stop: threading.Event) -> None:
        bauds = {termios.B57600: 57_600, termios.B115200: 115_200, termios.B38400: 38_400}
        while not stop.wait(0.01):
            if select.select([self._master], [], [], 0.0)[0]:
                self.heard += os.read(self._master, 4096)
            if words := self._says(bauds.get(termios.tcgetattr(self._master)[4], 0)):
                os.write(self._master, words)


@pytest.fixture
def serial_line() -> Iterator[Callable[..., Line]]:
    with ExitStack() as stack:
        yield lambda says=lambda baud: b"": stack.enter_context(Line(says))
