"""What the tests of the LUX share: a room to look at, a device in it, a scan made by hand."""

from dataclasses import replace

import numpy as np

from drivers.ibeo_lux.config import IbeoLuxConfig
from drivers.ibeo_lux.driver import IbeoLuxSession
from drivers.ibeo_lux.messages import POINT, Scan, write_scan
from drivers.ibeo_lux.protocol import DataType, Message, encode
from simulators.device import Sweep
from simulators.ibeo_lux import FakeIbeoLux, LuxSetup
from tests.drivers.virtual_time import SECOND_NS, Talk

UNIX_NS = 1_795_000_000 * SECOND_NS  # of virtual time 0


class Room:
    """A round room of 20 m that remembers when its first ray was cast."""

    def __init__(self):
        self.first_rays_ns = []

    def sweep(self, beams):
        self.first_rays_ns.append(beams.first_ray_ns)
        return Sweep(np.full(beams.count, 20.0, np.float32), np.full(beams.count, 0.5, np.float32))

    def sweep_layers(self, layer_count, beams):
        return [self.sweep(beams)] * layer_count


def config(**changes):
    return IbeoLuxConfig(**{"name": "lux", "host": "127.0.0.1"} | changes)


def talk(setup=None, **changes):
    """A session configured with `changes`, talking to a fake device in virtual time."""
    room = Room()
    t = Talk(None, FakeIbeoLux(room, setup or LuxSetup()), room=room)
    t.session = IbeoLuxSession(config(**changes), lambda: UNIX_NS + t.now_ns)
    return t.connect()


def reconnect(t, **changes):
    """A new session with the same device, as the link makes one after an error."""
    t.device.disconnected(t.now_ns)
    t.session = IbeoLuxSession(config(**changes), lambda: UNIX_NS + t.now_ns)
    return t.connect()


def points(*rows):
    """Rows of layer, echo, flags, angle_ticks, range_cm, width_cm."""
    array = np.zeros(len(rows), POINT)
    for place, (layer, echo, flags, angle_ticks, range_cm, width_cm) in zip(array, rows, strict=True):
        place["layer_echo"] = layer | echo << 4
        place["flags"], place["angle_ticks"] = flags, angle_ticks
        place["range_cm"], place["width_cm"] = range_cm, width_cm
    return array


def ntp(ns):
    return (ns << 32) // SECOND_NS


def scan(*rows, number=1, start_ns=10 * SECOND_NS, rate_hz=25.0, first=1600, last=-1920, **changes):
    sweep_ns = round(1e9 / rate_hz * (first - last) / 11_520)
    made = Scan(number, 0x030B, ntp(start_ns), ntp(start_ns + sweep_ns), first, last, points(*rows))
    return replace(made, **changes)


def wire(made):
    return encode(Message(DataType.SCAN, write_scan(made)))
