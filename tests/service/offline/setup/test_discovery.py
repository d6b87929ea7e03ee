from pathlib import Path

import pytest

from service.errors import UsageError
from service.offline.setup.discovery import Wire, discover, parse_wire, serial_ports
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from simulators.wire import TcpWire
from tests.drivers.lms100 import Room


@pytest.mark.parametrize(
    ("text", "wire"),
    [
        ("192.168.0.1", Wire(host="192.168.0.1")),
        ("lms-front:2112", Wire(host="lms-front", port=2112)),
        ("::1", Wire(host="::1")),
        ("/dev/ttyUSB0", Wire(device="/dev/ttyUSB0")),
        ("usb", Wire(device="usb")),
        ("socket://10.0.0.7:4000", Wire(device="socket://10.0.0.7:4000")),
        ("xsens_mtig=/dev/ttyUSB0", Wire(device="/dev/ttyUSB0", type="xsens_mtig")),
        ("ibeo_lux=10.0.0.7:12003", Wire(host="10.0.0.7", port=12003, type="ibeo_lux")),
    ],
)
def test_hosts_ports_and_types_are_read(text: str, wire: Wire):
    assert parse_wire(text) == wire


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sick=10.0.0.1", "sick is no type of sensor; known: sick_lms100"),
        ("a:port", "port is no port"),
        ("a:70000", "70000 is no port"),
        ("", "name a host or a device file"),
        ("999.1.1.1", "name a host or a device file"),
        ("a b:2111", "name a host or a device file"),
        ("a:\u00b2", "is no port"),
    ],
)
def test_what_is_no_wire_is_wrong_usage(text: str, words: str):
    with pytest.raises(UsageError, match=words):
        parse_wire(text)


def test_each_serial_port_is_asked_once_by_the_name_that_stays(tmp_path: Path):
    for name in ("ttyUSB0", "ttyUSB1", "ttyACM0", "ttyS0"):
        (tmp_path / name).write_text("")
    (tmp_path / "corridor").mkdir()
    (tmp_path / "corridor" / "xsens").symlink_to(tmp_path / "ttyUSB0")
    (tmp_path / "serial" / "by-id").mkdir(parents=True)
    for name, target in (("usb-Xsens", "ttyUSB0"), ("usb-Hokuyo", "ttyACM0")):
        (tmp_path / "serial" / "by-id" / name).symlink_to(tmp_path / target)
    names = ("corridor/xsens", "serial/by-id/usb-Hokuyo", "ttyUSB1")
    assert serial_ports(tmp_path) == [Wire(device=str(tmp_path / name)) for name in names]


ASK_S = 60.0  # a fake device on a busy machine; the first answer ends it


def found_at_a(setup: Lms100Setup):
    with TcpWire(FakeLms100(Room(), setup)) as (host, port):
        [found] = discover([Wire(host=host, port=port, type="sick_lms100")], ASK_S)
    return found


def test_another_model_of_the_same_telegram_is_found_with_the_setting_that_reads_it():
    found = found_at_a(Lms100Setup(model="lms5xx"))
    assert found.type == "sick_lms100"
    assert found.settings["model"] == "lms5xx"
    assert found.identity["device"] == "LMS511_FieldEval"
