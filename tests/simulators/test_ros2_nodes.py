"""Messages of fake ROS 2 nodes against the truth they measure; no wire is served."""

import math

import numpy as np
import pytest
import zenoh

from drivers.frames import Frame, ImuSample
from service.encoding import IMU, LASER_SCAN, ODOMETRY, decode_frame
from service.geometry.se2 import SE2
from simulators.device import Beams, FakeDevice
from simulators.registry import DEVICE_KINDS
from simulators.truth import LMS100, LaserTruth, Ride
from simulators.vehicle import parse_device
from simulators.worlds import build_world
from simulators.zenoh_wire import ZenohWire

START_NS = 1_000_000_000
STAND_S = 1.0


@pytest.fixture(scope="module")
def ride() -> Ride:
    return Ride(build_world("ring"), START_NS, STAND_S)


def node(kind: str, ride: Ride, **options: object) -> FakeDevice:
    known = DEVICE_KINDS[kind]
    device = known.build("it", known.options(clock_drift_ppm=0.0, **options), ride, 1).device
    device.connected(START_NS)
    return device


def published(device: FakeDevice, message_type: str, seconds: float) -> list[Frame]:
    """All that is due until then."""
    frames = []
    while (due_ns := device.next_due_ns(0)) is not None and due_ns < START_NS + seconds * 1e9:
        frame = decode_frame(message_type, device.due(due_ns), "it", due_ns)
        assert frame is not None
        frames.append(frame)
    return frames


def test_scans_are_those_of_the_laser_at_the_moment_of_their_stamp(ride: Ride):
    first, second = published(node("ros2_scan", ride, x_m=0.3, rate_hz=20.0), LASER_SCAN, 0.11)
    assert second.stamp_ns - first.stamp_ns == 50_000_000
    source = LaserTruth(ride, "it", SE2(0.3, 0.0, 0.0), LMS100, 1)
    sweep = source.sweep(
        Beams(START_NS, first.beam_interval_ns, -math.radians(135.0), math.radians(0.5), 541)
    )
    inside = (sweep.range_m >= first.range_min_m) & (sweep.range_m < first.range_max_m)
    assert np.array_equal(first.range_m[inside], sweep.range_m[inside])
    assert inside.sum() > 400


def test_odometry_follows_the_drive(ride: Ride):
    samples = published(node("ros2_odom", ride), ODOMETRY, 6.0)
    begin, last = ride.pose(START_NS), samples[-1]
    at_ns = START_NS + round((len(samples) - 1) * 2e7)
    true = begin.inverse() @ ride.pose(at_ns)
    path_length_m = math.hypot(true.x_m, true.y_m)
    assert path_length_m > 1.0
    assert math.hypot(last.x_m - true.x_m, last.y_m - true.y_m) < 0.1 * path_length_m  # wheels slip
    assert last.twist_mps_radps[0] > 0.1


def test_a_unit_at_rest_measures_gravity_alone(ride: Ride):
    samples = published(node("ros2_imu", ride), IMU, 0.5)
    assert len(samples) == 50
    mean = np.mean([s.force_mps2 for s in samples if isinstance(s, ImuSample)], axis=0)
    assert mean == pytest.approx((0.0, 0.0, 9.81), abs=0.3)


def test_a_topic_may_be_named(ride: Ride):
    known = DEVICE_KINDS["ros2_scan"]
    wire = known.build("it", known.options(topic="veh1/scan"), ride, 1)
    assert wire._topic.name == "/veh1/scan"
    with pytest.raises(ValueError, match="ROS 2 names are"):
        parse_device("it=ros2_scan:topic=a b")


def test_a_router_that_does_not_report_its_port_is_an_error(ride: Ride, monkeypatch: pytest.MonkeyPatch):
    class Silent:
        closed = False

        def zid(self) -> str:
            return "1"

        def get(self, key: str, timeout: float) -> list[zenoh.Reply]:
            return []

        def close(self) -> None:
            self.closed = True

    session = Silent()
    monkeypatch.setattr(zenoh, "open", lambda config: session)
    wire = ZenohWire(node("ros2_scan", ride), "/scan", LASER_SCAN, 0, "127.0.0.1", 0)
    with pytest.raises(OSError, match=r"router at 127.0.0.1:0 did not tell its port within 2 s"), wire:
        pass
    assert session.closed
