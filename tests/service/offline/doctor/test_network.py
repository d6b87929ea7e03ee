import errno
import socket

import pytest

from drivers.errors import TransportError
from service.offline.doctor.network import call_failed, look_at_route, resolve
from tests.service.offline.doctor.conftest import FakeTree

HEAD = "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\tMTU\tWindow\tIRTT\n"
VEHICLE_NET = "eth1\t0000A8C0\t00000000\t0001\t0\t0\t0\t00FFFFFF\t0\t0\t0\n"  # 192.168.0.0/24
OFFICE_NET = "eth0\t0000000A\t00000000\t0001\t0\t0\t0\t000000FF\t0\t0\t0\n"  # 10.0.0.0/8
DEFAULT = "eth0\t00000000\t0100000A\t0003\t0\t0\t0\t00000000\t0\t0\t0\n"  # by 10.0.0.1


def failed(number: int) -> TransportError:
    error = TransportError("cannot connect to 192.168.0.1:2111")
    error.__cause__ = TimeoutError("timed out") if number == 0 else OSError(number, "")
    return error


def test_a_cable_that_is_out_is_seen_before_the_device_is_called(tree: FakeTree):
    tree.write("/proc/net/route", HEAD + DEFAULT + VEHICLE_NET)
    assert look_at_route(tree.machine(), "front", "192.168.0.1") is None
    tree.write("/sys/class/net/eth1/carrier", "0\n")
    finding = look_at_route(tree.machine(), "front", "192.168.0.1")
    assert "nothing is plugged in there" in finding.measured


ARP = "IP address HW type Flags HW address Mask Device\n192.168.0.1 0x1 0x{} 00:06:77:00:00:01 * eth1\n"


@pytest.mark.parametrize(
    ("route", "arp", "number", "words"),
    [
        (VEHICLE_NET, "", errno.ECONNREFUSED, "nothing listens at port 2111"),
        (VEHICLE_NET, "", errno.ENETUNREACH, "no route to 192.168.0.1"),
        (VEHICLE_NET, "", errno.ECONNRESET, "hangs up at once"),
        (VEHICLE_NET, "", errno.EHOSTUNREACH, "no answer from 192.168.0.1"),
        (VEHICLE_NET, ARP.format(2), 0, "no answer from 192.168.0.1"),
        (VEHICLE_NET, ARP.format(0), 0, "no machine has the address"),
        (DEFAULT + OFFICE_NET, "", 0, "leads over eth0 and the gateway 10.0.0.1"),
        (VEHICLE_NET, "", errno.EPROTO, "cannot connect to 192.168.0.1:2111"),
    ],
)
def test_each_failure_has_its_own_text(tree: FakeTree, route: str, arp: str, number: int, words: str):
    tree.write("/proc/net/route", HEAD + route)
    tree.write("/proc/net/arp", arp)
    finding = call_failed(tree.machine(), "front", "192.168.0.1", 2111, failed(number))
    assert words in finding.measured
    assert finding.remedy


def test_a_name_without_an_address_is_reported(monkeypatch: pytest.MonkeyPatch):
    assert resolve("front", "127.0.0.1", 2111) == ("127.0.0.1", None)

    def no_address(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", no_address)
    _, finding = resolve("front", "front-scanner", 2111)
    assert "front-scanner has no address" in finding.measured
