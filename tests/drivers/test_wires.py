import pytest
from pydantic import BaseModel, ValidationError

from drivers.wires import DeviceFile, Host


class Wire(BaseModel):
    host: Host = "a"
    device: DeviceFile = "/dev/ttyS0"


@pytest.mark.parametrize(
    "host",
    [
        "192.168.0.1",
        "::1",
        "fe80::1%eth0",
        "localhost",
        "lms-front.local",
        "front_laser",
        "site.org.",
        f"{'a' * 63}.b",
    ],
)
def test_addresses_and_names_are_hosts(host: str):
    assert Wire(host=host).host == host


@pytest.mark.parametrize(
    "host",
    [
        *("", " ", "192.168.0. 1", "192.168.0.1 ", "192.168.0.1:2111", "tcp://192.168.0.1", "192.168.0.300"),
        *("192.168.0", "a..b", "-a", "a-", "a\0b", "a\nb", "ä", "a" * 254, "[::1]"),
        *("a" * 64, f"lms.{'a' * 64}.local"),
    ],
)
def test_what_is_no_host_is_refused_with_an_example(host: str):
    with pytest.raises(ValidationError, match=r"neither an IP address nor a host name; write 192\.168\.0\.1"):
        Wire(host=host)


@pytest.mark.parametrize(
    "device", ["/dev/corridor/create", "usb", "usb:0770", "socket://192.168.0.7:4000", "/dev/by-id/a b"]
)
def test_paths_and_urls_are_devices(device: str):
    assert Wire(device=device).device == device


@pytest.mark.parametrize("device", ["", "  ", " /dev/ttyS0", "/dev/ttyS0\n", "~/tty", "/dev/tty\0S0"])
def test_what_is_no_device_file_is_refused_with_an_example(device: str):
    with pytest.raises(ValidationError, match="/dev/ttyUSB0"):
        Wire(device=device)
