"""What the tests of the UTM-30LX share: a room to look at, a device in it, a wire that is late."""

import heapq
import itertools

import numpy as np

from drivers.hokuyo_utm30lx.config import HokuyoUtm30lxConfig
from drivers.hokuyo_utm30lx.driver import HokuyoUtm30lxSession
from drivers.hokuyo_utm30lx.scans import NO_ECHO, Scan, ScanRequest
from simulators.device import Sweep
from simulators.hokuyo_setup import Utm30lxSetup
from simulators.hokuyo_utm30lx import FakeUtm30lx
from tests.drivers.virtual_time import SECOND_NS, TICK_NS, Talk


class Room:
    """Ranges that depend on the beam alone, every tenth without echo; remembers what was asked."""

    def __init__(self):
        self.requested = []

    @property
    def first_rays_ns(self):
        return [first_ray_ns for first_ray_ns, *_ in self.requested]

    def sweep(self, first_ray_ns, beam_interval_ns, first_angle_rad, angle_step_rad, beam_count):
        self.requested.append((first_ray_ns, beam_interval_ns, first_angle_rad, angle_step_rad, beam_count))
        range_m = (1.0 + np.arange(beam_count) * 1e-3).astype(np.float32)
        range_m[::10] = np.nan
        return Sweep(range_m, np.linspace(0.1, 1.0, beam_count, dtype=np.float32))


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


class LateTalk:
    """Session and device with a wire between that delivers in order but late, as threads and buses do.

    delay_ns(sent_ns) is what a message of the device takes; the session is ticked after every read and 20 ms
    after it looked last, as drivers.link does.
    """

    TO_DEVICE_NS = 60_000
    WAKE_UP_NS = 40_000

    def __init__(self, session, device, delay_ns, now_ns=1_000 * SECOND_NS):
        self.session, self.device, self.now_ns = session, device, now_ns
        self.frames = []
        self._delay_ns = delay_ns
        self._events = []  # time, number, what, data
        self._number = itertools.count()
        self._last_arrival_ns = 0
        self._looks_at_ns = None
        self._send(device.connected(now_ns), now_ns)
        self._plan_look(now_ns)

    def run(self, seconds):
        end_ns = self.now_ns + round(seconds * SECOND_NS)
        while True:
            due_ns = self.device.next_due_ns(self.now_ns)
            if due_ns is not None and max(due_ns, self.now_ns) <= self._events[0][0]:
                self.now_ns = max(due_ns, self.now_ns)
                if self.now_ns >= end_ns:
                    return self
                self._send(self.device.due(self.now_ns), self.now_ns)
                continue
            if self._events[0][0] >= end_ns:
                self.now_ns = end_ns
                return self
            self.now_ns, _, what, data = heapq.heappop(self._events)
            what(data)

    def _put(self, at_ns, what, data=b""):
        heapq.heappush(self._events, (at_ns, next(self._number), what, data))

    def _send(self, data, sent_ns):
        if data:
            self._last_arrival_ns = max(self._last_arrival_ns, sent_ns + self._delay_ns(sent_ns))
            self._put(self._last_arrival_ns, self._arrive, data)

    def _arrive(self, data):
        self.frames += self.session.receive_data(data, self.now_ns)
        self._plan_look(self.now_ns + self.WAKE_UP_NS)

    def _plan_look(self, at_ns):
        self._looks_at_ns = at_ns
        self._put(at_ns, self._look)

    def _look(self, _):
        if self.now_ns != self._looks_at_ns:
            return  # there was a read in between
        self.session.tick(self.now_ns)
        said = bytes(self.session.outbox)
        self.session.outbox.clear()
        if said:
            self._put(self.now_ns + self.TO_DEVICE_NS, self._hear, said)
        self._plan_look(self.now_ns + TICK_NS)

    def _hear(self, data):
        self._send(self.device.receive_data(data, self.now_ns), self.now_ns)
