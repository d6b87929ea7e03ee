"""The doctor on real wires: good devices, faulty ones, and other programs."""

import random
import threading
from collections.abc import Callable
from typing import Any

import pytest

from drivers.irobot_create.config import IrobotCreateConfig
from drivers.irobot_create.driver import STREAM_IDS
from drivers.irobot_create.protocol import encode_frame
from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.protocol import Dialect
from drivers.transport import TcpTransport
from service.offline.doctor.devices import Patience, PortWire, TcpWire, examine_sensor, wire_of
from service.offline.doctor.findings import Finding
from service.offline.doctor.machine import Machine
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from tests.drivers.lms100 import Room
from tests.service.offline.doctor.conftest import Line, Parrot

QUICK = Patience(measure_s=0.5, start_up_s=0.8, other_settings_s=2.5, listen_s=0.3)
WAITING = Patience(measure_s=0.6, start_up_s=8.0)
SLOW, BURST = 0.2, 5.0  # of the rate: what arrives in half a second where other programs have the cores
OnTcp = Callable[[Any], tuple[str, int]]
SerialLine = Callable[..., Line]


def lms100(at: tuple[str, int], **changes: Any) -> Lms100Config:
    return Lms100Config(name="front", host=at[0], port=at[1], **changes)


def create(path: str, **changes: Any) -> IrobotCreateConfig:
    return IrobotCreateConfig(name="base", device=path, **changes)


def examine(config: Any, patience: Patience = QUICK) -> list[Finding]:
    return examine_sensor(Machine(), config, patience, threading.Event())


def fake_lms100(**setup: Any) -> FakeLms100:
    return FakeLms100(Room(), Lms100Setup(**setup))


def only(findings: list[Finding], severity: str = "fault") -> Finding:
    (finding,) = findings
    assert finding.severity == severity, finding
    assert finding.who
    assert severity == "ok" or finding.remedy
    return finding


@pytest.mark.usefixtures("any_rate_will_do")
def test_a_good_device_is_named_with_rate_identity_and_clock(on_tcp: OnTcp):
    finding = only(examine(lms100(on_tcp(fake_lms100())), WAITING), "ok")
    assert "device LMS10x_FieldEval" in finding.measured
    assert "serial 18090362" in finding.measured
    assert finding.values["identity.dialect"] == "CoLa-A"
    assert SLOW < float(finding.values["rate_hz"]) / 49.8 < BURST
    assert float(finding.values["delay_ms_p50"]) > 3.0


def test_a_web_server_in_the_devices_place_is_recognised(on_tcp: OnTcp):
    page = b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n<html></html>"
    finding = only(examine(lms100(on_tcp(Parrot(page)))))
    assert finding.measured == 'wrong protocol: a web server ("HTTP/1.1 400 Bad Request")'
    assert finding.expected == "messages of a sick_lms100"


def test_the_other_dialect_is_found_by_asking_in_it(on_tcp: OnTcp):
    finding = only(examine(lms100(on_tcp(fake_lms100(dialect=Dialect.BINARY)), dialect="cola_a")))
    assert "with dialect: cola_b a device does: dialect CoLa-B" in finding.measured
    assert finding.remedy == "write dialect: cola_b"


def test_a_device_that_serves_someone_else_is_recognised(on_tcp: OnTcp):
    at = on_tcp(fake_lms100())
    with TcpTransport(*at):
        finding = only(examine(lms100(at)))
    assert finding.measured == "accepts the connection and closes it without data"
    assert "is another host" in finding.remedy


def test_a_refusal_is_reported_with_the_drivers_own_advice(on_tcp: OnTcp):
    at = on_tcp(fake_lms100(measuring=False))
    finding = only(examine(lms100(at, password_hash="00000000"), WAITING))
    assert "login as authorised client refused" in finding.measured
    assert "Set password_hash" in finding.remedy


@pytest.mark.usefixtures("any_rate_will_do")
def test_a_setting_that_the_device_does_not_take_is_a_note(on_tcp: OnTcp):
    at = on_tcp(fake_lms100(refused=frozenset({"LMPoutputRange"})))
    first, *others = examine(lms100(at, last_angle_deg=90.0), WAITING)
    assert first.severity == "ok"
    assert {finding.severity for finding in others} == {"note"}
    assert any("configured field of view -135 to 90 deg not taken" in note.measured for note in others)


def test_a_rate_below_the_configured_one_is_a_fault(on_tcp: OnTcp):
    first, second = examine(lms100(on_tcp(fake_lms100(motor_speed=0.8))), WAITING)
    assert first.severity == "ok"
    assert second.severity == "fault"
    assert second.expected == "50 frames/s as configured"
    assert SLOW < float(second.measured.split()[0]) / 40.0 < BURST


def test_a_silent_robot_is_to_be_woken(serial_line: SerialLine):
    line = serial_line()
    finding = only(examine(create(line.path)))
    assert "nothing came" in finding.measured
    assert "Clean button" in finding.remedy
    assert line.heard.startswith(b"\x80")


def test_a_stream_at_another_rate_is_found_by_listening_alone(serial_line: SerialLine):
    frame = encode_frame(STREAM_IDS, dict.fromkeys(STREAM_IDS, 0))
    noise = bytes([0xFE, 0x80, 0xF8, 0x00, 0xE0, 0x66])
    line = serial_line(lambda baud: frame if baud == 57_600 else noise if baud == 115_200 else b"")
    finding = only(examine(create(line.path)))
    assert finding.measured == "noise at 115200 baud, while an iRobot Create or Roomba speaks at 57600"
    assert finding.remedy == "write baud: 57600, or set the device to 115200"


def test_noise_at_every_rate_is_reported_in_words(serial_line: SerialLine):
    dice = random.Random(1)
    line = serial_line(lambda baud: dice.randbytes(8))
    finding = only(examine(create(line.path)))
    assert finding.measured.startswith("at 115200 baud only noise comes: ")
    assert "RS-232" in finding.remedy


@pytest.mark.parametrize(
    ("device", "wire"),
    [
        ("/dev/ttyUSB0", PortWire("/dev/ttyUSB0")),
        ("socket://10.0.0.7:4000", TcpWire("10.0.0.7", 4000)),
        ("rfc2217://10.0.0.7:4000?logging=debug", TcpWire("10.0.0.7", 4000)),
        ("usb:0770123", None),
        ("loop://", None),
    ],
)
def test_a_wire_is_known_by_its_settings(device: str, wire: object):
    assert wire_of(create(device)) == wire
