import subprocess
import sys

import pytest

from service.sensor_kinds import SENSOR_KINDS
from simulators.registry import DEVICE_KINDS
from simulators.truth import Ride
from simulators.wire import PtyWire, TcpWire
from simulators.worlds import build_world
from simulators.zenoh_wire import ZenohWire


def test_each_type_of_sensor_has_a_fake_device():
    assert list(DEVICE_KINDS) == list(SENSOR_KINDS)


@pytest.mark.parametrize("name", list(DEVICE_KINDS))
def test_a_device_comes_to_its_wire_with_its_defaults(name: str):
    kind = DEVICE_KINDS[name]
    wire = kind.build("x", kind.options(), Ride(build_world("ring"), 0), 1)
    assert isinstance(wire, TcpWire | PtyWire | ZenohWire)
    assert wire.failure is None


def test_devices_that_are_not_asked_for_are_not_imported():
    code = """
import sys
from simulators.vehicle import parse_devices
parse_devices([])
print(*sorted(name for name in sys.modules if name.startswith("simulators.kinds.")))
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == ["simulators.kinds.irobot_create", "simulators.kinds.sick_lms100"]
