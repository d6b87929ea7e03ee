"""An LMS1xx that does not take a setting: its scans are used, cut to the field of view, and named."""

import queue
import socket
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from drivers.errors import DeviceError
from drivers.link import LinkHealth, run_link
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.protocol import Dialect, encode
from drivers.sick_lms100.telegrams import ScanDataConfig, write_scan
from drivers.transport import TcpTransport
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from tests.drivers.lms100 import Room, config, talk, telegram
from tests.drivers.virtual_time import Talk
from tests.in_background import in_background

HALF = {"first_angle_deg": -90.0, "last_angle_deg": 90.0}
WIDE = (
    "scans at 50 Hz and 0.5 deg from -135 to 135 deg, configured 50 Hz and 0.5 deg from -90 to 90 deg, "
    "cut to these angles by the driver"
)


def test_beams_that_the_driver_cuts_off_do_not_move_the_stamp_of_the_others():
    cut, whole = (Lms100Session(config(**changes)) for changes in (HALF, {}))
    wire = encode(write_scan(telegram(values=range(1000, 1541)), Dialect.ASCII))
    [frame], [full] = (session.receive_data(wire, 2_000_000_000) for session in (cut, whole))
    assert frame.stamp_ns == full.stamp_ns + 90 * full.beam_interval_ns
    np.testing.assert_array_equal(frame.range_m, full.range_m[90:451])


def test_device_that_goes_on_sending_every_second_scan_has_twice_the_period_and_misses_none():
    setup = Lms100Setup(
        scan_data=ScanDataConfig(1, False, False, interval=2), refused=frozenset({"LMDscandatacfg"})
    )
    t = talk(setup).run(4.0)
    assert t.frames[-1].scan_period_ns == 40_000_000
    assert t.frames[-1].stamp_ns - t.frames[-2].stamp_ns == pytest.approx(40_180_000, abs=100_000)
    assert t.session.counters["scans_missed"] == 0


def test_device_at_rest_that_cannot_be_logged_into_is_a_device_error():
    with pytest.raises(DeviceError, match=r"login .* refused .*password_hash"):
        Talk(
            Lms100Session(config(password_hash="00000000")), FakeLms100(Room(), Lms100Setup(measuring=False))
        ).connect().run(9.0)


def test_pretended_unit_of_2009_gives_scans_at_once(shared):
    script = shared / "cases/sick_v123_output_range.py"
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with subprocess.Popen([sys.executable, script, str(port)], stdout=subprocess.DEVNULL) as server:
        try:
            given, health, taken = (
                config(host="127.0.0.1", port=port, **HALF),
                LinkHealth("front"),
                queue.Queue(),
            )
            ends = partial(TcpTransport, given.host, given.port), partial(Lms100Session, given)
            with in_background(partial(run_link, health, *ends, taken.put)):
                frames = [taken.get(timeout=60.0) for _ in range(50)]
        finally:
            server.kill()
    assert {len(frame.range_m) for frame in frames} == {361}
    assert health.status.startswith(f"streaming; {WIDE}; configured field of view -90 to 90 deg not taken:")
