"""Every type of sensor through the same door: fake devices of each, in order, swapped, or the wrong unit."""

from contextlib import ExitStack
from typing import Any

import pytest

from service.sensor_kinds import SENSOR_KINDS
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from simulators.ibeo_lux import FakeIbeoLux
from simulators.sick_lms100 import FakeLms100
from simulators.wire import serve_pty, serve_tcp
from tests.drivers import lms100, lux, utm30lx
from tests.service.offline.doctor.test_devices import WAITING, examine, only


@pytest.fixture
def vehicle():
    """Configs of three lasers, and the fake devices they belong to."""
    with ExitStack() as stack:
        usb = stack.enter_context(serve_pty(FakeUtm30lx(utm30lx.Room(), Utm30lxSetup(wire="usb"))))
        ethernet = stack.enter_context(serve_tcp(FakeUtm30lx(utm30lx.Room(), Utm30lxSetup(wire="ethernet"))))
        four_layers = stack.enter_context(serve_tcp(FakeIbeoLux(lux.Room())))
        front = stack.enter_context(serve_tcp(FakeLms100(lms100.Room())))
        yield {
            "usb": utm30lx.config(device=usb, name="rear"),
            "ethernet": utm30lx.config(host=ethernet[0], port=ethernet[1], name="rear"),
            "lux": lux.config(host=four_layers[0], port=four_layers[1], name="front"),
            "lms100": lms100.config(host=front[0], port=front[1]),
        }


@pytest.mark.usefixtures("any_rate_will_do")
@pytest.mark.parametrize(
    ("name", "rate_hz", "identity"),
    [
        ("usb", 40.0, "UTM-30LX"),
        ("ethernet", 40.0, "UTM-30LX-EW"),
        ("lux", 25.0, ""),
        ("lms100", 49.8, "LMS10x"),
    ],
)
def test_each_type_is_looked_at_by_its_own_session(
    vehicle: dict[str, Any], name: str, rate_hz: float, identity: str
):
    first, *others = examine(vehicle[name], WAITING)
    assert first.severity == "ok"
    assert identity in first.measured
    assert float(first.values["rate_hz"]) > 0.2 * rate_hz  # in half a second of a machine that may be busy
    assert not [finding for finding in others if finding.severity == "fault"]


def test_a_swapped_unit_is_known_by_its_serial_number(vehicle: dict[str, Any]):
    finding = only(examine(vehicle["usb"].model_copy(update={"serial_number": "H0000001"}), WAITING))
    assert "expected serial_number H0000001" in finding.measured
    assert "swapped" in finding.remedy


@pytest.mark.parametrize("kind", list(SENSOR_KINDS))
def test_advice_takes_any_bytes(kind: str):
    recognise = SENSOR_KINDS[kind].advice.recognise
    for data in (b"", b"\x00" * 16_384, bytes(range(256)) * 64, b"HTTP/1.1 400 Bad Request\r\n\r\n"):
        assert recognise(data) == ""
