"""The vehicles of a site as they change, until it is closed."""

import logging
import math
import queue
import re
import threading
import time
from collections.abc import Callable
from functools import partial

import zenoh

from drivers.zenoh_callback import daemon_callback
from service.errors import StorageError
from service.fleet.vehicles import Vehicle, last_of, present, read_pose, vehicle_in, vehicle_of
from service.publishing.keys import vehicle_key
from service.publishing.uplink import PRESENCES, Presence, read_presence

log = logging.getLogger(__name__)

LOOK_S = 1.0
FIGURES = re.compile(r"\b\d+(\.\d+)?")  # not those of a name, as laser_2
Show = Callable[[Vehicle], None]


class Watch:
    """State of each vehicle, by one subscription for all of them."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._is_closed = False
        self._news: queue.SimpleQueue[str] = queue.SimpleQueue()  # vehicles
        self._health: dict[str, zenoh.Sample] = {}
        self._poses: dict[str, zenoh.Sample] = {}
        self._present: dict[str, list[Presence]] = {}
        self._changes, self._lock = 0, threading.Lock()  # of `_present`, by what came or went
        self._link = ""  # our end of it
        liveliness = session.liveliness()
        liveliness.declare_subscriber(PRESENCES, daemon_callback(self._came_or_went, "fleet-presence"))
        for channel, last in (("pose", self._poses), ("health", self._health)):
            keep = daemon_callback(partial(self._keep, last), f"fleet-{channel}")
            session.declare_subscriber(vehicle_key("*", channel), keep)
            for name, sample in last_of(session, channel).items():
                last.setdefault(name, sample)

    def run(self, show: Show, seconds: float | None, changes_only: bool) -> None:
        """Show a vehicle with each health message; with changes_only where its state, faults (not their
        figures) or sessions are others than before. seconds: None for ever.
        """
        until_s = time.monotonic() + seconds if seconds is not None else math.inf
        shown: dict[str, tuple[object, ...]] = {}
        while not self._is_closed and time.monotonic() < until_s:
            self._look_at_link()
            try:
                name = self._news.get(timeout=min(until_s - time.monotonic(), LOOK_S))
            except queue.Empty:
                continue
            vehicle = self.vehicle(name)
            if not changes_only or shown.get(name) != _what_counts(vehicle):
                shown[name] = _what_counts(vehicle)
                show(vehicle)

    def _look_at_link(self) -> None:
        """Zenoh does not report who goes with our own link: all have gone then, until it is back."""
        links = self._session.info.links()
        link = links[0].src if links else ""
        if link == self._link:
            return
        changes = self._changes
        try:
            here = present(self._session) if link else {}
        except StorageError as error:
            log.warning("%s; it is asked again", error)
            return
        with self._lock:
            if self._changes != changes:  # one that came meanwhile may be missing; it is queried again
                return
            before, self._present = self._present, here
        self._link = link
        if not link:
            log.warning("the link to the router is lost; it is tried again and again")
        for name in sorted({*before, *self._present, *self._health}):
            self._news.put(name)

    def close(self) -> None:
        """End `run`, within LOOK_S."""
        self._is_closed = True

    def pose(self, name: str) -> tuple[float, float, float] | None:
        """x, y (m) and heading (rad) of the base in the map, as it came last."""
        return read_pose(self._poses.get(name))

    def vehicle(self, name: str) -> Vehicle:
        """Present state of a vehicle; silent once its last session has ended."""
        sessions = self._present.get(name, ())
        health = self._health.get(name) if sessions else None
        return vehicle_of(name, health, self._poses.get(name), sessions)

    def _keep(self, last: dict[str, zenoh.Sample], sample: zenoh.Sample) -> None:
        name = vehicle_in(str(sample.key_expr))
        last[name] = sample
        if last is self._health:
            self._news.put(name)

    def _came_or_went(self, sample: zenoh.Sample) -> None:
        read = read_presence(str(sample.key_expr))
        if read is None:
            return
        name, presence = read
        is_here = sample.kind == zenoh.SampleKind.PUT
        with self._lock:
            self._changes += 1
            others = [one for one in self._present.get(name, []) if one != presence]
            self._present[name] = sorted([*others, presence]) if is_here else others
        if not is_here or others or name in self._health:  # else its first health message comes soon
            self._news.put(name)


def _what_counts(vehicle: Vehicle) -> tuple[object, ...]:
    """Faults without their figures: "1154 scans in 53.7 s were not mapped" has others each second."""
    faults = tuple(FIGURES.sub("#", fault) for fault in vehicle.faults)
    return vehicle.state, faults, vehicle.sessions, vehicle.map, vehicle.corridor
