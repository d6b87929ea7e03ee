from pathlib import Path

from service.offline.doctor.processes import holders, named, processes
from tests.service.offline.doctor.conftest import FakeTree


def test_processes_are_found_by_name_and_by_what_they_hold(tree: FakeTree):
    tree.process(5, "systemd-timesyn", "/lib/systemd/systemd-timesyncd")
    tree.process(6, "minicom", "minicom", holds="/dev/ttyUSB0")
    (tree.root / "proc/7").mkdir()  # gone while we look
    machine = tree.machine()
    assert [process.number for process in named(machine, "systemd-timesyncd", "ntpd")] == [5]
    assert [process.name for process in holders(machine, Path("/dev/ttyUSB0"))] == ["minicom"]
    assert len(list(processes(machine))) == 2
