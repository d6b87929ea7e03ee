"""What the tests of the LMS100 share: a room to look at, a device in it, a scan made by hand."""

from dataclasses import replace

import numpy as np

from drivers.sick_lms100.config import Lms100Config
from drivers.sick_lms100.driver import Lms100Session
from drivers.sick_lms100.telegrams import Channel, ScanTelegram
from simulators.device import Sweep
from simulators.sick_lms100 import FakeLms100
from simulators.sick_setup import Lms100Setup
from tests.drivers.virtual_time import Talk


class Room:
    """A round room of 3 m that remembers when its first ray was cast."""

    def __init__(self):
        self.first_rays_ns = []

    def sweep(self, beams):
        self.first_rays_ns.append(beams.first_ray_ns)
        range_m = np.full(beams.count, 3.0, np.float32)
        range_m[::10] = np.nan
        return Sweep(range_m, np.full(beams.count, 0.5, np.float32))


def config(**changes):
    return Lms100Config(**{"name": "front", "host": "127.0.0.1"} | changes)


def talk(setup=None, **changes):
    """A session configured with `changes`, talking to a fake device in virtual time."""
    room = Room()
    device = FakeLms100(room, setup or Lms100Setup())
    return Talk(Lms100Session(config(**changes)), device, room=room).connect()


def telegram(counter=4, start_us=1_000_000, sent_after_us=15_300, values=(1500,) * 541, **changes):
    channel = Channel("DIST1", np.array(values, dtype=np.uint16), -450_000, 5000)
    scan = ScanTelegram(
        1,
        (0, 0),
        (counter + 100) % 65_536,
        counter,
        start_us,
        start_us + sent_after_us,
        5000,
        360,
        (channel,),
    )
    return replace(scan, **changes)
