"""Open Interface clients against a fake Create 2 whose wheels turn evenly."""

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drivers.irobot_create.config import PRESETS
from drivers.irobot_create.protocol import Mode, Opcode, PacketId
from simulators.irobot_create import IDLE_VALUES, FakeCreate
from simulators.wire import PtyWire
from tests.interop.programs import InteropError, Venv, run_client

LEFT_MPS, RIGHT_MPS = 0.20, 0.26
START_COUNTS = (65_400, 31_000)  # the left one passes its wrap after a quarter of a second


class EvenWheels:
    """A WheelSource: both wheels roll at speeds of their own since start_ns."""

    def __init__(self, start_ns: int) -> None:
        self.start_ns = start_ns

    def wheel_travel_m(self, now_ns: int) -> tuple[float, float]:
        since_s = (now_ns - self.start_ns) * 1e-9
        return LEFT_MPS * since_s, RIGHT_MPS * since_s


def run_pycreate2(venv: Venv, folder: Path) -> str:
    asked = (Opcode.START, Opcode.SAFE, Opcode.FULL, Opcode.SENSORS, Opcode.DRIVE_DIRECT, Opcode.STOP)
    seen = _run(venv, "pycreate2_client.py", folder, asked, Mode.OFF)
    return (
        f"{seen['readings']} readings of 80 bytes, counts within {seen['slack_counts']} of the truth "
        f"over {seen['seconds']:.1f} s, {seen['distance_mm']} mm of {seen['true_distance_mm']:.0f} mm"
    )


def run_pyroombaadapter(venv: Venv, folder: Path) -> str:
    asked = (Opcode.START, Opcode.SAFE, Opcode.SENSORS, Opcode.STREAM, Opcode.DRIVE)
    seen = _run(venv, "pyroombaadapter_client.py", folder, asked, Mode.PASSIVE)
    return (
        f"{seen['requests']} packets asked for, {seen['frames']} stream frames, "
        f"{seen['left_counts']} left counts of {seen['true_left_counts']:.1f}"
    )


def _run(venv: Venv, script: str, folder: Path, asked: Sequence[Opcode], mode: Mode) -> dict[str, Any]:
    """The device must receive these commands, and be in that mode at the end."""
    wheels = EvenWheels(time.monotonic_ns())
    device = FakeCreate(wheels, "create2", start_counts=START_COUNTS)
    preset = PRESETS["create2"]
    with PtyWire(device) as path:
        facts = {
            "port": path,
            "start_ns": wheels.start_ns,
            "left_mps": LEFT_MPS,
            "right_mps": RIGHT_MPS,
            "start_counts": START_COUNTS,
            "m_per_count": math.pi * preset.wheel_diameter_m / preset.counts_per_revolution,
            "voltage_mv": IDLE_VALUES[PacketId.VOLTAGE],
            "current_ma": IDLE_VALUES[PacketId.CURRENT],
            "temperature_degc": IDLE_VALUES[PacketId.TEMPERATURE],
            "charge_mah": IDLE_VALUES[PacketId.BATTERY_CHARGE],
            "capacity_mah": IDLE_VALUES[PacketId.BATTERY_CAPACITY],
            "cliff_signals": [IDLE_VALUES[packet_id] for packet_id in range(28, 32)],
            "bump_signals": [IDLE_VALUES[packet_id] for packet_id in range(46, 52)],
        }
        seen = run_client(venv, script, facts, folder)
    heard = {command.opcode for command in device.commands}
    if missing := [opcode.name for opcode in asked if opcode not in heard]:
        raise InteropError(f"the device never heard {', '.join(missing)}, only {sorted(heard)}")
    if device.mode is not mode:
        raise InteropError(f"the client left the device in mode {device.mode.name}, expected {mode.name}")
    return seen
