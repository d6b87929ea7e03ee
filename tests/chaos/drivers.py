"""Every driver through every fault again and again, in virtual time; and through all of them together."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from simulators.fault_file import KINDS
from tests.drivers.faulty_devices import BENCHES, Bench, linked
from tests.drivers.virtual_link import VirtualLink

CALM_BEFORE_S = 6.0  # all devices stream by then
CALM_AFTER_S = 30.0  # the longest way back: a robot given up after 8 s, then the longest back-off
WATCH_S = 5.0
EVERY_S = 12.0
RATE_TOLERANCE = 0.03
LONGEST_GAP_S = 25.0  # faults of several kinds in a row, a silence waited for, the longest back-off
OLDEST_FRAME_S = 5.0  # a frame held back by a second of burst and delay is not so old

Draw = Callable[[float, float], float]


def _parameters(kind: str, draw: Draw) -> str:
    """How bad this one is; as YAML."""
    share = f"for_s: {draw(0.2, 3.0):.2f}, share: {draw(0.05, 1.0):.2f}"
    match kind:
        case "cut":
            return f"for_s: {draw(0.05, 3.0):.2f}"
        case "restart":
            return f"for_s: {draw(0.2, 3.0):.2f}"
        case "silence":
            return f"for_s: {draw(0.2, 8.0):.2f}"
        case "slow_start":
            return f"for_s: {draw(0.5, 3.0):.2f}"
        case "clock_jump":
            return f"by_s: {draw(0.6, 3000.0) * (1 if draw(0, 1) < 0.5 else -1):.2f}"
        case "bit_flips":
            return f"for_s: {draw(0.2, 3.0):.2f}, rate: {10 ** draw(-5, -2):.6f}"
        case "garbage":
            return f"{share}, up_to_bytes: {round(draw(1, 3000))}"
        case "delay":
            return f"for_s: {draw(0.5, 3.0):.2f}, up_to_ms: {draw(1, 300):.0f}"
        case "burst":
            return f"for_s: {draw(0.5, 3.0):.2f}, hold_ms: {draw(20, 900):.0f}"
        case _:
            return share


def fault_line(kind: str, chance: np.random.Generator, last_s: float, every_s: float = EVERY_S) -> str:
    """A fault of that kind, some time in the first half of every_s and of each that follows, until last_s;
    YAML without the device.
    """
    parameters = _parameters(kind, lambda low, high: float(chance.uniform(low, high)))
    if kind == "slow_start":
        return f"kind: slow_start, {parameters}"
    at_s = CALM_BEFORE_S + float(chance.uniform(0.0, every_s / 2))
    count = max(1, int((last_s - at_s) / every_s))
    return f"kind: {kind}, at_s: {at_s:.2f}, {parameters}, every_s: {every_s}, count: {count}"


def kinds_for(bench: Bench) -> list[str]:
    return [
        kind
        for kind in KINDS
        if (kind != "clock_jump" or bench.has_clock) and (kind != "wrong_checksum" or bench.has_sum)
    ]


@dataclass(frozen=True)
class Row:
    """What became of one device. `defect` is "" where it came back as it was."""

    device: str
    faults: str
    times: int
    harmed: int  # messages
    connects: int
    frames: int
    longest_gap_s: float
    defect: str


def run_one(name: str, what: str, lines: list[str], seconds: float, seed: int) -> Row:
    """That many seconds of faults, then calm; is all as it was before?"""
    link = linked(name, *lines, seed=seed)
    defect = ""
    try:
        before = link.run(CALM_BEFORE_S)
        link.run(seconds - CALM_BEFORE_S + CALM_AFTER_S)
        defect = _compare(BENCHES[name], link, before, link.run(WATCH_S))
    except Exception as error:  # a driver may raise what drivers.link catches, which ended there, and no more
        defect = f"{type(error).__name__}: {error}"
    counters = link.device.counters
    return Row(
        name,
        what,
        sum(counters[kind] for kind in KINDS),
        sum(count for key, count in counters.items() if key.startswith("messages_")),
        link.connects,
        len(link.frames),
        _longest_gap_s(link),
        defect,
    )


def _compare(bench: Bench, link: VirtualLink, before: list[Any], after: list[Any]) -> str:
    rate_hz = len(after) / WATCH_S
    if abs(rate_hz - bench.rate_hz) > RATE_TOLERANCE * bench.rate_hz:
        return f"{rate_hz:.1f} frames a second after it, expected {bench.rate_hz:.1f}; {link.status}"
    if before:  # a slow start leaves nothing to compare with
        lags_ns = [
            float(np.median([f.arrived_ns - f.stamp_ns for f in frames])) for frames in (before, after)
        ]
        if abs(lags_ns[1] - lags_ns[0]) > bench.fineness_ns:
            return f"stamps are off by {(lags_ns[1] - lags_ns[0]) / 1e6:.2f} ms after it"
    if any(b.stamp_ns <= a.stamp_ns for a, b in itertools.pairwise(link.frames)):
        return "stamps went back"
    ages_s = [(frame.arrived_ns - frame.stamp_ns) / 1e9 for frame in link.frames]
    for age_s in (min(ages_s), max(ages_s)):
        if not 0.0 <= age_s < OLDEST_FRAME_S:
            return f"a frame was stamped {age_s:.3f} s before it came"
    if _longest_gap_s(link) > LONGEST_GAP_S:
        return f"away for {_longest_gap_s(link):.0f} s"
    return ""


def _longest_gap_s(link: VirtualLink) -> float:
    gaps_ns = (b.arrived_ns - a.arrived_ns for a, b in itertools.pairwise(link.frames))
    return max(gaps_ns, default=0) / 1e9


def campaign(seconds: float, seed: int, names: list[str]) -> Iterator[Row]:
    """A row for each device and kind, and one for each device and all kinds together, five times as long."""
    for name in names:
        kinds = kinds_for(BENCHES[name])
        for number, kind in enumerate(kinds):
            chance = np.random.default_rng([seed, number])
            lines = [fault_line(kind, chance, seconds)]
            if kind == "slow_start":  # it shows after restarts
                lines.append(fault_line("restart", chance, seconds))
            yield run_one(name, kind, lines, seconds, seed)
        chance = np.random.default_rng([seed, len(kinds)])
        lines = [fault_line(kind, chance, 5 * seconds, every_s=5 * EVERY_S) for kind in kinds]
        yield run_one(name, "all kinds", lines, 5 * seconds, seed)
