"""Faults of every kind that a device can have, drawn in time and strength, as lines of a file of faults."""

from collections.abc import Callable

import numpy as np

from simulators.fault_file import KINDS
from tests.drivers.faulty_devices import BENCHES

CALM_BEFORE_S = 6.0  # all devices stream by then
DEVICES = {"front": "lms100 cola_a", "base": "create2"}  # of the demo, by their benches
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


def drawn(seed: int, seconds: float) -> str:
    """Each kind on two devices together, once, some time in the first half of the drive."""
    text = ""
    for number, (device, bench) in enumerate(DEVICES.items()):
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
