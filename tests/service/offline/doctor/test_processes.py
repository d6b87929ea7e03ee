import os
import socket
from pathlib import Path

import pytest

from service.offline.doctor.machine import Machine
from service.offline.doctor.processes import Process, holders, listeners, named, processes
from tests.service.offline.doctor.conftest import FakeTree


@pytest.mark.parametrize(
    ("arguments", "is_service"),
    [
        (("/opt/corridor/venv/bin/python", "/opt/corridor/venv/bin/corridor", "run", "v.yaml"), True),
        (("corridor", "demo"), True),
        (("python", "/opt/corridor/venv/bin/corridor", "-v", "run", "v.yaml"), True),
        (("sudo", "-u", "corridor", "corridor", "run", "v.yaml"), True),
        (("python", "-m", "service", "run", "v.yaml"), True),
        (("python", "-m", "service", "--verbose", "demo"), True),
        (("python", "-m", "service", "-v", "check", "run"), False),
        (("python", "-m", "pytest", "service", "run"), False),
        (("corridor", "doctor", "v.yaml"), False),
        (("vi", "run", "corridor"), False),
        (("corridor",), False),
    ],
)
def test_the_service_is_known_by_its_command(arguments: tuple[str, ...], is_service: bool):
    assert Process(1, "x", arguments).is_service is is_service


def test_processes_are_found_by_name_and_by_what_they_hold(tree: FakeTree):
    tree.process(5, "systemd-timesyn", "/lib/systemd/systemd-timesyncd")
    tree.process(6, "minicom", "minicom", holds="/dev/ttyUSB0")
    (tree.root / "proc/7").mkdir()  # gone while we look
    machine = tree.machine()
    assert [process.number for process in named(machine, "systemd-timesyncd", "ntpd")] == [5]
    assert [process.name for process in holders(machine, Path("/dev/ttyUSB0"))] == ["minicom"]
    assert len(list(processes(machine))) == 2


def test_the_real_proc_knows_who_listens():
    with socket.create_server(("127.0.0.1", 0)) as door:
        found, anybody = listeners(Machine(), door.getsockname()[1])
        assert anybody
        assert [process.number for process in found] == [os.getpid()]
        with socket.create_connection(door.getsockname()) as caller:
            assert listeners(Machine(), caller.getsockname()[1]) == ([], False)
