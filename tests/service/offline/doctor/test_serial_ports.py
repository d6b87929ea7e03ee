import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.offline.doctor.serial_ports import known_ports, look_at_port
from tests.service.offline.doctor.conftest import FakeTree

PORT = "/dev/ttyUSB0"


@pytest.fixture
def terminal() -> Iterator[str]:
    """A real character device, so that its number and rights are real."""
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(slave)
    os.close(master)


@pytest.fixture
def port(tree: FakeTree, terminal: str) -> Path:
    """The terminal as /dev/ttyUSB0 of an FTDI adapter."""
    number = os.stat(terminal).st_rdev
    tree.write(f"/sys/dev/char/{os.major(number)}:{os.minor(number)}/uevent", "DEVNAME=ttyUSB0\n")
    return tree.link(PORT, terminal)


def sysfs(tree: FakeTree, terminal: str, folder: str = "/sys/dev/char/") -> str:
    number = os.stat(terminal).st_rdev
    return f"{folder}{os.major(number)}:{os.minor(number)}"


def test_a_missing_port_names_those_that_are_there(tree: FakeTree, terminal: str):
    tree.link("/dev/ttyUSB3", terminal)
    tree.write("/dev/ttyACM0", "")
    (tree.root / "dev/serial/by-id").mkdir(parents=True)
    tree.link("/dev/serial/by-id/usb-Hokuyo-if00", "../../ttyACM0")
    look = look_at_port(tree.machine(), "base", "/dev/corridor/create")
    assert not look.can_be_opened
    (finding,) = look.findings
    assert finding.severity == "fault"
    assert "/dev/corridor/create is not there" in finding.measured
    assert "/dev/serial/by-id/usb-Hokuyo-if00 (ttyACM0), /dev/ttyUSB3" in finding.measured
    assert "udev rule" in finding.remedy
    assert known_ports(tree.machine()) == ["/dev/serial/by-id/usb-Hokuyo-if00 (ttyACM0)", "/dev/ttyUSB3"]


def test_who_has_no_rights_learns_which_group_to_join(
    tree: FakeTree, port: Path, monkeypatch: pytest.MonkeyPatch
):
    group = os.stat(port).st_gid
    monkeypatch.setattr("service.offline.doctor.serial_ports.group_name", lambda _: "dialout")
    port.resolve().chmod(0o660)
    requested: list[Path] = []
    machine = tree.machine(may_read_and_write=lambda path: bool(requested.append(path)))
    (finding,) = look_at_port(machine, "base", PORT).findings
    assert requested == [port]
    assert "user driver may not read and write /dev/ttyUSB0" in finding.measured
    assert "crw-rw----" in finding.measured
    assert finding.remedy.startswith("sudo usermod -aG dialout driver")

    monkeypatch.setattr("service.offline.doctor.serial_ports.members_of", lambda _: ["driver"])
    (finding,) = look_at_port(machine, "base", PORT).findings
    assert "since after this login" in finding.remedy

    machine = tree.machine(may_read_and_write=lambda path: False, group_ids=frozenset({group}))
    (finding,) = look_at_port(machine, "base", PORT).findings
    assert "container or a sandbox" in finding.remedy

    port.resolve().chmod(0o600)
    (finding,) = look_at_port(machine, "base", PORT).findings
    assert 'MODE="0660"' in finding.remedy


def test_who_holds_the_port_is_named(tree: FakeTree, port: Path, terminal: str):
    tree.process(77, "minicom", "minicom", holds=terminal)
    tree.process(78, "bash", "bash")
    look = look_at_port(tree.machine(), "base", PORT)
    assert not look.can_be_opened
    (finding,) = look.findings
    assert finding.measured == "/dev/ttyUSB0 is held by minicom (process 77)"
    assert "kill 77" in finding.remedy


def test_modem_manager_is_only_a_danger_where_it_may_take_the_port(tree: FakeTree, port: Path, terminal: str):
    assert look_at_port(tree.machine(), "base", PORT).findings == ()
    tree.process(600, "ModemManager", "/usr/sbin/ModemManager")
    look = look_at_port(tree.machine(), "base", PORT)
    assert look.can_be_opened
    (finding,) = look.findings
    assert finding.severity == "note"
    assert "ModemManager (process 600) runs" in finding.measured
    assert "ID_MM_DEVICE_IGNORE" in finding.remedy
    tree.write(sysfs(tree, terminal, "/run/udev/data/c"), "E:ID_MM_DEVICE_IGNORE=1\n")
    assert look_at_port(tree.machine(), "base", PORT).findings == ()
