"""What the tests of the UTM-30LX share: a room to look at, a device in it."""

import numpy as np

from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.hokuyo_utm30lx.scans import NO_ECHO, Scan, ScanRequest
from simulators.device import Sweep
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from tests.drivers.virtual_time import Talk

NARROW = {"first_angle_deg": -20.0, "last_angle_deg": 20.0}  # where what it sees is no matter: quicker made


class Room:
    """Ranges that depend on the beam alone, every tenth without echo; remembers what was asked."""

    def __init__(self):
        self.requested = []

    @property
    def first_rays_ns(self):
        return [beams.first_ray_ns for beams in self.requested]

    def sweep(self, beams):
        self.requested.append(beams)
        range_m = (1.0 + np.arange(beams.count) * 1e-3).astype(np.float32)
        range_m[::10] = np.nan
        return Sweep(range_m, np.linspace(0.1, 1.0, beams.count, dtype=np.float32))


def config(**changes):
    wire = {} if "host" in changes or "device" in changes else {"device": "/dev/ttyACM0"}
    return HokuyoUtm30lxConfig(**{"name": "rear"} | wire | changes)


def talk(setup=None, **changes):
    """A session configured with `changes`, talking to a fake device in virtual time."""
    setup = setup or Utm30lxSetup(wire="ethernet" if "host" in changes else "usb")
    room = Room()
    session = HokuyoUtm30lxSession(config(**changes))
    return Talk(session, FakeUtm30lx(room, setup), room=room).connect()


def random_scan(seed, request=None):
    """A scan with any values, and any number of echoes where the request has them."""
    rng = np.random.default_rng(seed)
    request = request or ScanRequest("MD", 0, 1080)
    largest = 4095 if request.value_chars == 2 else 262_143
    rows = 3 if request.multi_echo else 1
    distance_mm = rng.integers(0, largest + 1, (rows, request.beam_count)).astype(np.int32)
    distance_mm[np.arange(rows)[:, np.newaxis] >= rng.integers(1, rows + 1, request.beam_count)] = NO_ECHO
    intensity = rng.integers(0, 20_000, distance_mm.shape).astype(np.int32)
    intensity[distance_mm == NO_ECHO] = NO_ECHO
    stamp_ms = int(rng.integers(0, 1 << 24))
    return Scan(request, stamp_ms, distance_mm, intensity if request.with_intensity else distance_mm[:0])
