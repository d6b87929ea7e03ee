"""Every driver through every fault: it counts, it comes back, and what it says then is right again."""

import itertools
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest

from drivers.irobot_create.driver import session_maker as create_sessions
from drivers.link import LinkHealth, Session, run_link
from drivers.sick_lms100.driver import Lms100Session
from drivers.transport import SerialTransport, TcpTransport, Transport
from drivers.xsens_mtig.driver import XsensMtigSession
from simulators.device import FakeDevice
from simulators.irobot_create import FakeCreate
from simulators.sick_lms100 import FakeLms100
from simulators.wire import PtyWire, TcpWire
from tests.drivers import irobot_bench, lms100, mtig
from tests.drivers.faulty_devices import BENCHES, ZERO_NS, faulty, linked
from tests.drivers.virtual_link import VirtualLink
from tests.drivers.virtual_time import SECOND_NS
from tests.in_background import started
from tests.soaked import in_soak

PATIENCE_S = 60.0
FAULT_AT_S = 4.0  # all devices stream by then
RECOVERY_S = 7.0  # the longest is a silence timeout, then two refused connections
RELEARNT_S = 3.5  # a clock that jumped, where the link stays
WATCH_S = 2.0

LOSSES = {  # kind -> what the drivers call the loss; one of them has to grow
    "garbage": {"bytes_skipped", "replies_unreadable"},
    "bit_flips": {
        *("bytes_skipped", "scans_malformed", "checksum_errors", "checksum_failures", "answers_refused"),
    },
    "half_messages": {"bytes_skipped", "scans_missed", "frames_missed", "answers_missed", "samples_missed"},
    "wrong_checksum": {"checksum_errors", "checksum_failures", "scans_malformed"},
    "drop": {"scans_missed", "frames_missed", "answers_missed", "samples_missed"},
    "duplicate": {"scans_duplicate", "scans_with_a_stamp_twice", "scans_repeated", "samples_out_of_order"},
}
STAYS = (
    *("duplicate, for_s: 1", "delay, for_s: 1, up_to_ms: 30", "burst, for_s: 1, hold_ms: 200"),
    *("silence, for_s: 0.7", "half_messages, for_s: 1, share: 0.3", "wrong_checksum, for_s: 1, share: 0.5"),
    *("drop, for_s: 1, share: 0.5", "clock_jump, by_s: 30", "clock_jump, by_s: -30"),
)
MAY_GO = ("garbage, for_s: 1", "bit_flips, for_s: 1, rate: 0.001")
GOES = ("cut, for_s: 1", "restart, for_s: 1", "silence, for_s: 9")
NAMES = [name for name in BENCHES if name != "utm30lx ethernet"]  # the two units differ in other things


DRIVERS = ("lms100", "utm30lx", "lux", "mtig", "create")


def cases(faults: Sequence[str]) -> list[Any]:
    """Each fault on a device of every third driver that has what it spoils, and the drivers take turns from
    fault to fault, as do the protocols where a driver speaks two; `make soak` runs the others.
    """
    found = []
    for turn, fault in enumerate(faults):
        has = [[n for n in NAMES if n.startswith(d) and has_what_is_spoilt(n, fault)] for d in DRIVERS]
        for place, spoilt in enumerate(names for names in has if names):
            is_turn = (turn + place) % 3 == 0
            for k, name in enumerate(spoilt):
                is_now = is_turn and k == turn // 3 % len(spoilt)
                found.append((name, fault) if is_now else in_soak(name, fault))
    return found


def has_what_is_spoilt(name: str, fault: str) -> bool:
    bench = BENCHES[name]
    return (bench.has_clock or not fault.startswith("clock_jump")) and (
        bench.has_sum or not fault.startswith("wrong_checksum")
    )


@dataclass
class Watched:
    """A device's fault, seen from its driver: frames before it, frames when it should be over, the loss."""

    link: VirtualLink
    before: list[Any]
    after: list[Any]
    counted: Counter[str]  # from the begin of the fault on


def watch(name: str, fault: str, recovery_s: float = RECOVERY_S) -> Watched:
    kind, _, rest = fault.partition(", ")
    link = linked(name, f"kind: {kind}, at_s: {FAULT_AT_S}, {rest}")
    before, counters = link.run(FAULT_AT_S), Counter(link.counters)
    link.run(float(rest.split("for_s: ")[1].split(",")[0]) if "for_s" in rest else 0.0)
    link.run(recovery_s)
    return Watched(link, before, link.run(WATCH_S), link.counters - counters)


def lag_ns(frames: list[Any]) -> float:
    """From the moment of measurement to the arrival; the same before and after, if stamps are right."""
    return float(np.median([frame.arrived_ns - frame.stamp_ns for frame in frames]))


def check_recovered(name: str, watched: Watched) -> None:
    assert len(watched.after) == pytest.approx(WATCH_S * BENCHES[name].rate_hz, abs=2)
    assert lag_ns(watched.after) == pytest.approx(lag_ns(watched.before), abs=BENCHES[name].fineness_ns)
    stamps_ns = [frame.stamp_ns for frame in watched.link.frames]
    assert all(a < b for a, b in itertools.pairwise(stamps_ns))


def check_counted(name: str, fault: str, watched: Watched) -> None:
    kind = fault.split(",")[0]
    if kind in LOSSES:
        assert watched.link.device.counters[f"messages_hit_by_{kind}"] > 0
        if not (kind == "duplicate" and name.startswith("create")):  # its frames carry no number
            assert LOSSES[kind] & watched.counted.keys(), watched.counted
    if kind == "clock_jump":
        assert watched.counted["clock_resets"] == 1


@pytest.mark.parametrize(("name", "fault"), cases(STAYS))
def test_it_stays_connected_and_counts(name: str, fault: str):
    watched = watch(name, fault, RELEARNT_S)
    check_recovered(name, watched)
    check_counted(name, fault, watched)
    assert (watched.link.connects, watched.link.errors) == (1, [])


@pytest.mark.parametrize(("name", "fault"), cases(MAY_GO))
def test_it_counts_noise_and_is_back_within_seconds(name: str, fault: str):
    watched = watch(name, fault)
    check_recovered(name, watched)
    check_counted(name, fault, watched)
    assert watched.link.connects <= 2


@pytest.mark.parametrize(("name", "fault"), cases(GOES))
def test_it_comes_back_with_a_new_connection(name: str, fault: str):
    watched = watch(name, fault)
    check_recovered(name, watched)
    assert watched.link.connects >= 2
    words = "no .* for 2 s|silent for 8 s|no valid answer for 8 s" if "silence" in fault else "unplugged"
    assert re.search(words, str(watched.link.errors[0][1]))


@pytest.mark.parametrize(
    "name",
    [name if name not in ("lms100 cola_b", "mtig legacy", "create2") else in_soak(name) for name in NAMES],
)
def test_it_waits_for_a_device_that_starts_slowly_each_time(name: str):
    link = linked(name, "kind: slow_start, for_s: 3", "kind: restart, at_s: 12, for_s: 1")
    link.run(12.0)
    assert link.frames[0].arrived_ns > ZERO_NS + 3 * SECOND_NS
    assert len(link.run(4.0)) <= 1
    link.run(6.0)
    assert len(link.run(WATCH_S)) == pytest.approx(WATCH_S * BENCHES[name].rate_hz, abs=2)


@pytest.mark.parametrize("name", ["create2", "create1"])
def test_a_robot_switched_off_and_on_behind_a_cable_that_stays_is_asked_again(name: str):
    link = linked(name, f"kind: restart, at_s: {FAULT_AT_S}, for_s: 1, link_drops: false")
    link.run(FAULT_AT_S + 1.0 + RECOVERY_S)
    assert len(link.run(WATCH_S)) == pytest.approx(WATCH_S * BENCHES[name].rate_hz, abs=2)
    assert link.connects == 1


def test_a_seed_gives_the_same_bytes_and_the_same_frames_again():
    lines = (
        "kind: bit_flips, for_s: 1, every_s: 2, rate: 0.0005",
        "kind: garbage, at_s: 1, for_s: 1, every_s: 3",
        "kind: cut, at_s: 4, for_s: 0.5, every_s: 5",
    )

    def drive(seed: int) -> tuple[Any, ...]:
        link = linked("lms100 cola_b", *lines, seed=seed)
        link.run(15.0)
        return link.sent, [frame.stamp_ns for frame in link.frames], link.counters, link.device.counters

    once = drive(1)
    assert drive(1) == once
    assert drive(2)[0] != once[0]


class Linked:
    """run_link in a thread, and a condition that tells of frames."""

    def __init__(self, open_transport: Callable[[], Transport], new_session: Callable[[], Session]) -> None:
        self.health = LinkHealth("x")
        self.frames: list[Any] = []
        self._changed = threading.Condition()
        self._stop = threading.Event()
        arguments = (self.health, open_transport, new_session, self._take, self._stop)
        self._running = started(partial(run_link, *arguments))

    def _take(self, frame: Any) -> None:
        with self._changed:
            self.frames.append(frame)
            self._changed.notify_all()

    def wait(self, connects: int, more: int = 20) -> None:
        """Until that many connections were made, and frames come on the last."""
        with self._changed:
            assert self._changed.wait_for(lambda: self.health.connects >= connects, PATIENCE_S), self.health
            enough = len(self.frames) + more
            assert self._changed.wait_for(lambda: len(self.frames) >= enough, PATIENCE_S), self.health

    def close(self) -> None:
        self._stop.set()
        self._running.result(PATIENCE_S)


@pytest.fixture
def link() -> Iterator[Callable[..., Linked]]:
    opened: list[Linked] = []

    def start(open_transport: Callable[[], Transport], new_session: Callable[[], Session]) -> Linked:
        opened.append(Linked(open_transport, new_session))
        return opened[-1]

    yield start
    for one in opened:
        one.close()


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("kind: cut, at_s: 1.2, for_s: 0.3", "reset|refused|closed"),
        ("kind: restart, at_s: 1.2, for_s: 0.3", "reset|refused|closed"),
        ("kind: silence, at_s: 1.2, for_s: 1.5", "no scan for 0.5 s"),
    ],
)
def test_lms100_comes_back_over_tcp(link: Callable[..., Linked], fault: str, error: str):
    device = faulty(FakeLms100(lms100.Room()), fault, zero_ns=time.monotonic_ns())
    config = lms100.config(silence_timeout_s=0.5)
    with TcpWire(device) as address:
        linked = link(lambda: TcpTransport(*address), lambda: Lms100Session(config))
        linked.wait(connects=1)
        linked.wait(connects=2)
        linked.close()
    assert linked.health.state == "streaming"
    np.testing.assert_array_equal(linked.frames[-1].range_m[1:10], np.full(9, 3.0, np.float32))
    errors = linked.health.last_error
    assert any(word in errors for word in error.split("|")), errors


@pytest.mark.parametrize(
    ("name", "fault", "connects"),
    [
        ("create", "kind: cut, at_s: 1, for_s: 0.3", 2),
        ("create", "kind: restart, at_s: 1, for_s: 0.3", 2),
        ("create", "kind: restart, at_s: 1, for_s: 0.3, link_drops: false", 1),
        ("create", "kind: silence, at_s: 1, for_s: 0.5", 1),
        ("mtig", "kind: cut, at_s: 1, for_s: 0.3", 2),
    ],
)
def test_device_comes_back_over_a_terminal(
    link: Callable[..., Linked], tmp_path: Any, name: str, fault: str, connects: int
):
    makers: dict[str, tuple[FakeDevice, Callable[[], Session]]] = {
        "create": (FakeCreate(irobot_bench.STANDING), create_sessions(irobot_bench.CONFIG)),
        "mtig": (mtig.mtdata2(), lambda: XsensMtigSession(mtig.config())),
    }
    fake, new_session = makers[name]
    device = faulty(fake, fault, zero_ns=time.monotonic_ns())
    with PtyWire(device, tmp_path / "device") as path:
        linked = link(lambda: SerialTransport(path, 115_200), new_session)
        linked.wait(connects=1)
        linked.wait(connects, more=150)  # 2 s, beyond what the fault takes
        linked.close()
    assert linked.health.state == "streaming"
    assert linked.health.connects == connects
    assert device.counters["cut"] + device.counters["restart"] + device.counters["silence"] == 1
