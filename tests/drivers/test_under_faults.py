"""Every driver through every fault: it counts, it comes back, and what it says then is right again."""

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tests.drivers.faulty_devices import BENCHES, ZERO_NS, linked
from tests.drivers.virtual_link import VirtualLink
from tests.drivers.virtual_time import SECOND_NS
from tests.soaked import in_soak

FAULT_AT_S = 4.0  # all devices stream by then
RECOVERY_S = 7.0  # the longest is a silence timeout, then two refused connections
RELEARNT_S = 3.5  # a clock that jumped, where the link stays
WATCH_S = 2.0

LOSSES = {  # kind -> what the drivers call the loss; one of them has to grow
    "garbage": {"bytes_skipped", "replies_unreadable"},
    "bit_flips": {
        *("bytes_skipped", "scans_malformed", "checksum_errors", "checksum_failures", "answers_refused")
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
