"""The campaign: the faults of a drive, and the bounds of its figures.

Faults of devices and wires act in virtual time (`Wire`), where each scan has its state and nothing depends on
the machine; all others act on processes, in real time (`Live`).
"""

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from service.demo import DEVICES, STAND_S
from simulators.fault_file import KINDS
from tests.chaos import faults as f
from tests.chaos import virtual
from tests.chaos.drive import Interval, Up, driving
from tests.chaos.judge import Expected, Figures, judge, judged, worst
from tests.drivers.faulty_devices import BENCHES, ZERO_NS

AT_S = 9.0  # after the ride began: the vehicle drives
CALM_S = 6.0  # after it
UNKNOWN = math.inf  # not judged
USUAL = Expected()
OF_WIRES = Expected(data_lost_s=UNKNOWN)  # without messages there is no recording
BOOT_S, BETWEEN_S = 0.5, 0.3  # from the ride's begin to the first device, and to each further one
RANDOM_S = 60.0
Result = tuple[Figures, list[str]]  # with notes
CALM_BEFORE_S = 6.0  # all devices stream by then
BENCH_OF = {"front": "lms100 cola_a", "base": "create2"}  # of the demo, by their benches
PARAMETERS: dict[str, tuple[tuple[str, float, float], ...]] = {  # name, least, most; of other kinds: SHARES
    "cut": (("for_s", 0.05, 3.0),),
    "restart": (("for_s", 0.2, 3.0),),
    "silence": (("for_s", 0.2, 8.0),),
    "slow_start": (("for_s", 0.5, 3.0),),
    "clock_jump": (("by_s", -3000.0, 3000.0),),
    "bit_flips": (("for_s", 0.2, 3.0), ("rate", 1e-5, 1e-2)),
    "delay": (("for_s", 0.5, 3.0), ("up_to_ms", 1.0, 300.0)),
    "burst": (("for_s", 0.5, 3.0), ("hold_ms", 20.0, 900.0)),
}
SHARES = (("for_s", 0.2, 3.0), ("share", 0.05, 1.0))


@dataclass(frozen=True)
class Wire:
    """A fault of devices or their wires, as text; `lines` of a file of faults, one for each run."""

    fault: str
    lines: Sequence[str]
    lasts_s: float
    at_s: float = AT_S
    calm_s: float = CALM_S
    expected: Expected = OF_WIRES

    def run(self, seed: int, say: Callable[[str], object]) -> Result:
        """Figures, the worst of all runs."""
        found = []
        ends_s = self.at_s + self.lasts_s
        cause = Interval(ZERO_NS + round(self.at_s * 1e9), ZERO_NS + round(ends_s * 1e9))
        up = Up(ZERO_NS, ZERO_NS + round((ends_s + self.calm_s) * 1e9), False, 0)
        for number, lines in enumerate(self.lines, 1):
            drive = virtual.drive(lines, ends_s + self.calm_s, seed)
            found.append(judge(drive.evidence, drive.truth, cause, [up]))
            if len(self.lines) > 1:
                say(f"run {number} of {len(self.lines)}: {found[-1]}")
        return worst(found), []


@dataclass(frozen=True)
class Live:
    """A fault of processes, disks, clocks or the network, as text; it lasts as long as `act`.

    place     what it needs around the run
    settings  of the config, by section
    """

    fault: str
    act: f.Act
    expected: Expected = USUAL
    place: f.Place = lambda folder: nullcontext({})
    settings: Callable[[], dict[str, Any]] = dict

    def run(self, seed: int, say: Callable[[str], object]) -> Result:
        """Raises CannotBeHadError, AssertionError."""
        with TemporaryDirectory(prefix="corridor-chaos-") as name, self.place(Path(name)) as settings:
            with driving(Path(name), settings, seed) as drive:
                drive.configure(**self.settings())
                drive.start()
                drive.run_until(AT_S)
                f.wait_for_poses(drive.service.endpoint)  # a busy machine takes long to start
                with drive.caused():
                    self.act(drive)
                drive.run_until((drive.cause.until_ns - drive.ride_ns) / 1e9 + CALM_S)
                drive.end()
            if drive.ups[-1].code not in self.expected.codes:
                drive.notes.append(drive.service.log.splitlines()[-1])
            if drive.left_out:
                drive.notes.append(f"the fake devices had no processor to send {drive.left_out} messages")
            return judged(drive), drive.notes


def wire(
    fault: str, kind: str, parameters: str, lasts_s: float, devices: Sequence[str] = tuple(DEVICES)
) -> Wire:
    lines = [f"  - {{device: {device}, kind: {kind}, at_s: {AT_S}, {parameters}}}\n" for device in devices]
    return Wire(fault, ["".join(lines)], lasts_s)


def boot_order(order: Sequence[str]) -> str:
    """Devices connect to the network one after the other."""
    return "".join(
        f"  - {{device: {device}, kind: cut, for_s: {BOOT_S + BETWEEN_S * place:.1f}}}\n"
        for place, device in enumerate(order)
    )


def rows(seed: int, kills: int) -> dict[str, Wire | Live]:
    clocks = [name for name in DEVICES if name != "base"]
    others = [name for name in DEVICES if name != "front"]
    cables = {
        f"cable-{name}": wire(f"cable of `{name}` out for 2 s", "cut", "for_s: 2", 2.0, [name])
        for name in DEVICES
    }
    return cables | {
        "cables-long": wire("cables of all but `front` out for 12 s", "cut", "for_s: 12", 12.0, others),
        "boot-order": Wire(
            "devices boot one after the other, in each of the 120 orders",
            [boot_order(order) for order in permutations(DEVICES)],
            BETWEEN_S * (len(DEVICES) - 1),
            at_s=BOOT_S,
            calm_s=STAND_S + 1.0,
        ),
        "restart": wire("power of all devices off for 1 s", "restart", "for_s: 1", 1.0),
        "silence": wire("all devices silent for 3 s", "silence", "for_s: 3", 3.0),
        "half": wire("30 % of messages cut off", "half_messages", "for_s: 2, share: 0.3", 2.0),
        "bits": wire("1 of 10 000 bits flipped", "bit_flips", "for_s: 2, rate: 0.0001", 2.0),
        "garbage": wire("garbage before 30 % of messages", "garbage", "for_s: 2, share: 0.3", 2.0),
        "drop": wire("30 % of messages lost", "drop", "for_s: 2, share: 0.3", 2.0),
        "duplicate": wire("each message twice", "duplicate", "for_s: 2", 2.0),
        "delay": wire("messages up to 100 ms late", "delay", "for_s: 2, up_to_ms: 100", 2.0),
        "burst": wire("messages kept and sent each 0.5 s", "burst", "for_s: 2, hold_ms: 500", 2.0),
        "clock-ahead": wire("clocks of the devices step by 100 s", "clock_jump", "by_s: 100", 0.0, clocks),
        "clock-back": wire("clocks of the devices step by -100 s", "clock_jump", "by_s: -100", 0.0, clocks),
        "random": Wire(
            "each kind of fault by chance on `front` and `base`, 60 s",
            [random_faults(seed, RANDOM_S)],
            RANDOM_S - CALM_BEFORE_S,
            CALM_BEFORE_S,
            expected=Expected(data_lost_s=UNKNOWN, rmse_m=UNKNOWN, end_m=UNKNOWN),
        ),
        "ports": Live("another program opens the ports of all devices for 2 s", f.other_program(2.0)),
        "ntp-ahead": Live(
            "the computer's clock steps by an hour (NTP)", f.clock_step(3600), place=f.wall_clock
        ),
        "ntp-back": Live("the same, by an hour back", f.clock_step(-3600), place=f.wall_clock),
        "ntp-first": Live(
            "the same, from 1970, where a clock without a battery begins, to today",
            f.clock_step(0),
            place=lambda folder: f.wall_clock(folder, -int(time.time())),
        ),
        "router": Live("the site's router gone for 3 s", f.router_gone(3.0), place=f.router),
        "disk-frozen": Live("disk of the recordings frozen for 5 s", f.frozen_disk(5.0), place=f.disk),
        "disk-full": Live("the same full for 3 s", f.full_disk(3.0), Expected(data_lost_s=8.0), f.disk),
        "disk-read-only": Live(
            "the same read-only, after an error of ext4; it stays so",
            f.read_only_disk,
            Expected(recovery_s=UNKNOWN, data_lost_s=UNKNOWN, codes=(1,)),
            f.disk,
        ),
        "memory": Live(
            "memory limited to 80 % of what is in use, for 3 s (cgroup)",
            f.less_memory(0.8, 3.0),
            Expected(recovery_s=5.0, data_lost_s=5.0),
            f.memory_group,
        ),
        "stop-service": Live(
            "service stopped for 3 s (SIGSTOP)", f.stopped("service", 3.0), Expected(data_lost_s=3.5)
        ),
        "stop-mapper": Live("mapper stopped for 5 s", f.stopped("mapper", 5.0)),
        "stop-stand-by": Live("stand-by stopped for 5 s", f.stopped("stand-by", 5.0)),
        "stop-back-end": Live("back end stopped for 5 s", f.stopped("back end", 5.0), Expected(codes=(0, 1))),
        "kill-mapper": Live("mapper killed 5 times, each 2 s (SIGKILL)", f.killed("mapper", 5)),
        "kill-stand-by": Live("stand-by killed 5 times, each 2 s", f.killed("stand-by", 5)),
        "kill-back-end": Live(
            "back end killed 3 times, each 2 s", f.killed("back end", 3), Expected(codes=(0, 1))
        ),
        "kill-service": Live(
            f"service killed {kills} times, up to 3 s after READY, and started again",
            f.service_killed(kills, 3.0),
            Expected(recovery_s=5.0, rmse_m=UNKNOWN, end_m=UNKNOWN, codes=(0, 1, -9)),
            settings=lambda: {"map": {"checkpoint_s": 2.0}},
        ),
    }


def random_faults(seed: int, seconds: float) -> str:
    """Lines of each kind on two devices, once each, at a random time in the first half of the drive."""
    text = ""
    for number, (device, bench) in enumerate(BENCH_OF.items()):
        uniform: Callable[[float, float], float] = np.random.default_rng([seed, number]).uniform
        for kind in _kinds_for(bench):
            parts = [f"{name}: {uniform(low, high):.6g}" for name, low, high in PARAMETERS.get(kind, SHARES)]
            if kind != "slow_start":
                parts.append(f"at_s: {CALM_BEFORE_S + uniform(0.0, seconds / 2.0):.2f}")
            text += f"  - {{device: {device}, kind: {kind}, {', '.join(parts)}}}\n"
    return text


def _kinds_for(bench: str) -> list[str]:
    has = {"clock_jump": BENCHES[bench].has_clock, "wrong_checksum": BENCHES[bench].has_sum}
    return [kind for kind in KINDS if has.get(kind, True)]
