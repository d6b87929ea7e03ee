"""`corridor run` with a laser that refuses its field of view: scans, cut on the host, and a status."""

import math
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from service.encoding import OK, Status, decode_diagnostics
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from simulators.wire import serve_tcp
from tests.drivers.lms100 import Room
from tests.system.machine import LiveService, Subscriber

SCANS = 20


def test_laser_that_refuses_its_field_of_view_is_cut_recorded_and_named(
    tmp_path: Path, subscribe: Callable[[str], Subscriber]
):
    setup = Lms100Setup(firmware="V1.23", refused=frozenset({"LMPoutputRange"}))
    with serve_tcp(FakeLms100(Room(), setup)) as (_, port):
        laser = {"type": "sick_lms100", "host": "127.0.0.1", "port": port}
        service = LiveService(tmp_path, {"front": laser | {"first_angle_deg": -90, "last_angle_deg": 90}})
        try:
            service.start()
            subscriber = subscribe(service.endpoint)
            subscriber.wait_for("front/scan", SCANS)
            subscriber.wait_until(lambda: "not taken" in str(_statuses(subscriber)))
            front = _statuses(subscriber)["sensor/front"]
            service.signal(signal.SIGTERM)
            assert service.wait() == 0, service.log
        finally:
            service.close()
    assert front.level == OK
    assert "from -135 to 135 deg, configured 50 Hz and 0.5 deg from -90 to 90 deg, cut" in front.message
    assert "configured field of view -90 to 90 deg not taken: LMPoutputRange refused" in front.message
    (session,) = service.sessions.iterdir()
    typestore = get_typestore(Stores.ROS2_JAZZY)
    with session.open("rb") as file:
        scans = [
            typestore.deserialize_cdr(message.data, "sensor_msgs/msg/LaserScan")
            for _, _, message in make_reader(file).iter_messages(topics=["/front/scan"])
        ]
    assert len(scans) >= SCANS
    assert {len(scan.ranges) for scan in scans} == {361}
    for angle_rad, angle_deg in ((scans[0].angle_min, -90.0), (scans[0].angle_max, 90.0)):
        assert math.degrees(angle_rad) == pytest.approx(angle_deg, abs=0.01)


def _statuses(subscriber: Subscriber) -> dict[str, Status]:
    """The newest, by name."""
    heard = subscriber.heard.get("health", [])
    return {status.name: status for _, payload in heard[-1:] for status in decode_diagnostics(payload)}
