"""Faults of the rows are such as the demo's devices can have, and happen."""

import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from service.demo import DEVICES
from simulators.fault_file import parse_faults
from simulators.truth import Ride
from simulators.vehicle import FakeVehicle, parse_devices
from simulators.worlds import build_world
from tests.chaos.faults import CannotBeHadError, set_wall_clock, wall_clock
from tests.chaos.rows import Wire, rows


def test_the_files_of_faults_are_accepted_and_every_boot_order_is_there_once():
    """The first and the last file of each row is read."""
    specs = parse_devices([f"{name}={kind}" for name, (kind, _) in DEVICES.items()])
    devices = FakeVehicle(specs, Ride(build_world("room"), 0), 1).devices
    made = rows(seed=1, kills=1)
    for name, row in made.items():
        for lines in (row.lines[0], row.lines[-1]) if isinstance(row, Wire) else ():
            faults = parse_faults(f"faults:\n{lines}", name, devices)
            assert {fault.device for fault in faults} <= DEVICES.keys()
            if name == "boot-order":
                assert len({fault.device for fault in faults}) == len({fault.for_s for fault in faults}) == 5
    assert len(set(made["boot-order"].lines)) == len(made["boot-order"].lines) == 120


@pytest.mark.soak
def test_a_loop_of_the_map_that_began_after_a_silence_does_not_move_the_map_found_again():
    """The first scan begins a map of its own, the next ones lie on the old map; then a loop joins both."""
    silence = rows(seed=1, kills=1)["silence"]
    assert isinstance(silence, Wire)
    figures, _ = replace(silence, calm_s=3.0).run(1, print)
    assert (figures.end_m < 0.03, figures.wrong_ok) == (True, 0), figures


CLOCKS = "import time\nfor _ in range(2): print(time.time(), time.monotonic(), flush=True); input()"


def test_the_wall_clock_of_a_process_steps_while_it_runs_and_its_monotonic_clock_does_not(tmp_path: Path):
    try:
        with wall_clock(tmp_path, begins_s=-7200) as settings:
            process = subprocess.Popen(
                [sys.executable, "-S", "-c", CLOCKS],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | settings["environment"],
            )
            with process:
                seen = [process.stdout.readline()]
                set_wall_clock(tmp_path, 3600)
                process.stdin.write("\n")
                process.stdin.flush()
                seen.append(process.stdout.readline())
    except CannotBeHadError as error:
        pytest.skip(str(error))
    for line, step_s in zip(seen, (-7200, 3600), strict=True):
        unix_s, monotonic_s = map(float, line.split())
        assert unix_s == pytest.approx(time.time() + step_s, abs=60.0)
        assert monotonic_s == pytest.approx(time.monotonic(), abs=60.0)
