import errno
import socket
from collections.abc import Iterator

import pytest

from service.config import parse_config
from service.offline.doctor.endpoints import look_at_pages, look_at_zenoh
from service.offline.doctor.findings import Finding
from service.offline.doctor.machine import Machine
from service.offline.doctor.running import RunningService
from tests.service.offline.doctor.conftest import FakeTree

CONFIG = """\
vehicle: veh1
sensors: {front: {type: sick_lms100, host: 127.0.0.1}}
recording: {directory: s}
map: {directory: m}
"""


def look(machine: Machine, endpoint: str) -> tuple[Finding, RunningService | None]:
    config = parse_config(f'{CONFIG}publishing: {{listen: ["{endpoint}"], security: none}}\n', "v.yaml")
    (finding,), running = look_at_zenoh(machine, config)
    return finding, running


def look_at(
    machine: Machine, who: str, listen: str, running: RunningService | None = None, enabled: bool = True
) -> list[Finding]:
    """At the listening of `web` or `foxglove` alone."""
    other = "foxglove" if who == "web" else "web"
    sections = (
        f'{who}: {{enabled: {str(enabled).lower()}, listen: "{listen}"}}\n{other}: {{enabled: false}}\n'
    )
    return look_at_pages(machine, parse_config(CONFIG + sections, "v.yaml"), running)


@pytest.fixture
def taken() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as door:
        yield door.getsockname()[1]


def test_a_port_that_another_program_took_is_a_fault(taken: int):
    finding, running = look(Machine(), f"tcp/127.0.0.1:{taken}")
    assert finding.severity == "fault"
    assert f"tcp/127.0.0.1:{taken} is taken by " in finding.measured
    assert "process" in finding.measured
    assert running is None


def test_the_running_service_is_recognised(tree: FakeTree, taken: int):
    tree.process(41, "corridor", "python3", "/venv/bin/corridor", "run", "v.yaml")
    finding, running = look(tree.machine(), f"tcp/127.0.0.1:{taken}")
    assert finding.severity == "note"
    assert "corridor (process 41) is the running service" in finding.measured
    assert running.endpoint == f"tcp/127.0.0.1:{taken}"


def test_the_page_of_the_running_service_is_good(tree: FakeTree, taken: int):
    tree.process(41, "corridor", "corridor", "run", "v.yaml")
    _, running = look(tree.machine(), f"tcp/127.0.0.1:{taken}")
    (finding,) = look_at(tree.machine(), "web", f"127.0.0.1:{taken}", running)
    assert finding.severity == "ok"
    assert finding.measured == f"127.0.0.1:{taken} is served by the running service, corridor (process 41)"
    (alone,) = look_at(tree.machine(), "web", f"127.0.0.1:{taken}")
    assert alone.severity == "fault"  # of another vehicle: its page takes the port of this one's


@pytest.mark.parametrize("listen", ["127.0.0.1:80", "[::1]:80"])
def test_a_port_that_the_user_may_not_bind_is_a_fault_with_both_remedies(tree: FakeTree, listen: str):
    def refuse(door: socket.socket, address: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    (finding,) = look_at(tree.machine(bind=refuse), "web", listen)
    assert finding.measured == f"cannot listen at {listen}: driver may not bind port 80"
    assert finding.remedy == (
        "change web.listen to a port from 1024 on, or give the service CAP_NET_BIND_SERVICE"
    )
    zenoh, _ = look(tree.machine(bind=refuse), f"tcp/{listen}")
    assert "driver may not bind port 80" in zenoh.measured
