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
