import socket
from collections.abc import Iterator

import pytest

from service.config import parse_config
from service.offline.doctor.endpoints import look_at_zenoh
from service.offline.doctor.findings import Finding
from service.offline.doctor.machine import Machine
from service.offline.doctor.running import RunningService
from tests.service.offline.doctor.conftest import FakeTree


def look(machine: Machine, endpoint: str) -> tuple[Finding, RunningService | None]:
    text = f"""\
vehicle: veh1
sensors: {{front: {{type: sick_lms100, host: 127.0.0.1}}}}
publishing: {{listen: ["{endpoint}"]}}
recording: {{directory: s}}
map: {{directory: m}}
"""
    (finding,), running = look_at_zenoh(machine, parse_config(text, "v.yaml"))
    return finding, running


@pytest.fixture
def taken() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as door:
        yield door.getsockname()[1]


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:{}", "udp/127.0.0.1:{}", "tcp/0.0.0.0:{}"])
def test_a_free_port_is_good_and_free_again(tree: FakeTree, closed_port: int, endpoint: str):
    for _ in range(2):
        finding, running = look(tree.machine(), endpoint.format(closed_port))
        assert finding.severity == "ok"
        assert running is None


def test_a_port_that_a_stranger_took_is_a_fault(taken: int):
    finding, running = look(Machine(), f"tcp/127.0.0.1:{taken}")
    assert finding.severity == "fault"
    assert f"tcp/127.0.0.1:{taken} is taken by " in finding.measured
    assert "process" in finding.measured
    assert running is None


def test_a_port_of_a_hidden_process_is_a_fault_too(tree: FakeTree, taken: int):
    finding, _ = look(tree.machine(), f"tcp/127.0.0.1:{taken}")
    assert "another user's process" in finding.measured


def test_the_running_service_is_recognised(tree: FakeTree, taken: int):
    tree.process(41, "corridor", "python3", "/venv/bin/corridor", "run", "v.yaml")
    finding, running = look(tree.machine(), f"tcp/127.0.0.1:{taken}")
    assert finding.severity == "note"
    assert "corridor (process 41) is the running service" in finding.measured
    assert running is not None
    assert running.endpoint == f"tcp/127.0.0.1:{taken}"


def test_an_address_of_another_machine_is_a_fault(tree: FakeTree):
    finding, _ = look(tree.machine(), "tcp/192.0.2.1:7447")  # of the documentation's net, RFC 5737
    assert finding.severity == "fault"
    assert "this machine has no such address" in finding.measured


def test_a_socket_file_is_not_tried(tree: FakeTree):
    finding, _ = look(tree.machine(), "unixsock-stream//run/corridor/zenoh.sock")
    assert finding.measured.endswith("is not tried")
