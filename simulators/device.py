"""The seam between a fake device and the wire that carries it. No I/O."""

import math
from collections import Counter
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

CATCH_UP_NS = 1_000_000_000  # so far behind its time a device still sends every turn
TURNS_SKIPPED = "turns_skipped"  # name of the counter of those it left out beyond that


def turns_to_skip(behind_ns: int, period_ns: float, keep_ns: int = CATCH_UP_NS) -> int:
    """How many turns a device leaves out whose next one is behind_ns over its time: none up to keep_ns, all
    but the newest beyond. A real device is never late, but the process of a fake one may get no processor for
    a while: what was measured then is sent late, with its right device time. A device that cannot
    catch up begins again at the present, so that it does not stay late.
    """
    return math.floor(behind_ns / period_ns) if behind_ns > keep_ns else 0


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One sweep as the optics deliver it, before a device codes it. NaN in range_m: no echo."""

    range_m: npt.NDArray[np.float32]  # (N,)
    intensity: npt.NDArray[np.float32]  # (N,) 0..1


class FakeDevice(Protocol):
    """A fake device: bytes and time in, bytes out. Times are the host's monotonic clock, ns.

    The wire calls `connected` when a client connects, `receive_data` for what it sends, `due` whenever
    `next_due_ns` is reached, `disconnected` when it disconnects. A device that keeps running without a client
    (a spinning laser) computes from `now_ns` what it missed.
    """

    def connected(self, now_ns: int) -> bytes: ...
    def receive_data(self, data: bytes, now_ns: int) -> bytes: ...
    def next_due_ns(self, now_ns: int) -> int | None: ...
    def due(self, now_ns: int) -> bytes: ...
    def disconnected(self, now_ns: int) -> None: ...


@runtime_checkable
class ManyClients(Protocol):
    """A device with several clients at a time: each gets a FakeDevice of its own, which has the state of the
    connection (login, subscription) and shares the state of the device.
    """

    def new_client(self) -> FakeDevice: ...


@runtime_checkable
class Restartable(Protocol):
    """A device whose power can be cycled."""

    def restart(self, now_ns: int) -> None:
        """Power comes back: connection, unsaved settings, counters and clock start over."""
        ...


@runtime_checkable
class CountsTurns(Protocol):
    """A device that measures by turns, and counts those it had to skip as TURNS_SKIPPED."""

    counters: Counter[str]


@runtime_checkable
class HasClock(Protocol):
    """A device whose messages have times of its own clock."""

    def jump_clock(self, seconds: float) -> None:
        """Set the clock forward, or back where negative; the device does not report it."""
        ...


@runtime_checkable
class HasChecksum(Protocol):
    """A device whose messages have checksums."""

    def spoil_checksum(self, message: bytes) -> bytes:
        """The message with a wrong checksum and all else valid; unchanged where it carries none."""
        ...


@runtime_checkable
class Unpluggable(Protocol):
    """A device that is unplugged at times: the wire polls, resets its clients and closes its port."""

    def plugged(self, now_ns: int) -> bool: ...

    def next_plug_ns(self, now_ns: int) -> int | None:
        """When `plugged` may change next; None: never."""
        ...


@dataclass(frozen=True, slots=True)
class Beams:
    """Of a sweep: beam i is cast at first_ray_ns + i * interval_ns, at first_angle_rad + i * step_rad."""

    first_ray_ns: int
    interval_ns: int
    first_angle_rad: float
    step_rad: float
    count: int


class SweepSource(Protocol):
    """The scans of a laser: the truth with this laser's own errors."""

    def sweep(self, beams: Beams) -> Sweep:
        """Each beam is cast from the vehicle's pose at its own time."""
        ...


class LayeredSweepSource(Protocol):
    """The scans of a laser of several layers, each layer with noise of its own."""

    def sweep_layers(self, layer_count: int, beams: Beams) -> list[Sweep]:
        """As SweepSource.sweep, one sweep each layer; layers are close together and meet the same walls."""
        ...


class WheelSource(Protocol):
    """The measurements of wheel encoders: true travel with slip and scale error, before quantisation."""

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        """Path length rolled by the left and the right wheel since the world began, m; negative backwards."""
        ...
