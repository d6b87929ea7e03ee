"""What `python -m simulators` does: parses, starts a vehicle of fake devices, waits for a signal."""

import argparse
import gc
import json
import logging
import math
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np

from service.errors import ConfigError, StorageError
from simulators.fault_file import read_faults
from simulators.registry import DEVICE_KINDS
from simulators.truth import Ride
from simulators.vehicle import FakeVehicle, parse_devices, warm_up
from simulators.worlds import WORLDS, build_world

log = logging.getLogger("simulators")

DONE, FAILED, USAGE, IO_ERROR = 0, 1, 64, 74
MAX_STAND_S = 1e6
LOOK_S = 0.05  # how often the truth is written and the parent looked for
REPORT_S = 10.0  # how often losses are reported
TRUTH_STEP_NS = 5_000_000
SWITCH_INTERVAL_S = 0.0005  # a thread per device: none delays another for long


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(USAGE, f"{self.prog}: {message}\n")


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0.0 <= seconds <= MAX_STAND_S:
        raise argparse.ArgumentTypeError(f"{text!r}: expected seconds from 0 to {MAX_STAND_S:g}")
    return seconds


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = _Parser(
        prog="corridor simulate", description="Fake devices on a vehicle that drives through a world."
    )
    parser.add_argument("--world", default="office", choices=sorted(WORLDS))
    parser.add_argument(
        "--device",
        action="append",
        default=[],
        metavar="NAME=TYPE[:key=value,...]",
        help=f"may be repeated; TYPE is one of {', '.join(DEVICE_KINDS)}; without: one laser and one base",
    )
    parser.add_argument("--seed", type=int, default=1, help="of all noise (default 1)")
    parser.add_argument(
        "--stand-s",
        type=_seconds,
        default=2.0,
        help="how long the vehicle stands before it drives (default 2)",
    )
    parser.add_argument("--faults", type=Path, metavar="FILE", help="what goes wrong, and when; a YAML file")
    parser.add_argument(
        "--print-endpoints", action="store_true", help="JSON lines on stdout, the last is ready"
    )
    parser.add_argument(
        "--truth", type=Path, metavar="PATH", help="write stamp_ns x_m y_m theta_rad of the base, 200 Hz"
    )
    parser.add_argument("--die-with-parent", action="store_true", help="end when the parent process has gone")
    options = parser.parse_args(arguments)
    try:
        options.device = parse_devices(options.device)
    except ValueError as error:
        parser.error(str(error))
    return options


class TruthFile:
    """Poses of the base in the frame of its start, one each TRUTH_STEP_NS of the host's monotonic clock."""

    def __init__(self, ride: Ride, file: BinaryIO) -> None:
        self._ride = ride
        self._file = file
        self._next_ns = ride.start_ns

    def write_until(self, now_ns: int) -> None:
        """Raises StorageError where the disk does not take it."""
        stamps_ns = np.arange(self._next_ns, now_ns + 1, TRUTH_STEP_NS, dtype=np.int64)
        if stamps_ns.size == 0:
            return
        text = "".join(
            f"{stamp_ns} {x_m:.6f} {y_m:.6f} {theta_rad:.7f}\n"
            for stamp_ns, (x_m, y_m, theta_rad) in zip(stamps_ns, self._ride.poses(stamps_ns), strict=True)
        )
        try:
            self._file.write(text.encode())
        except OSError as error:
            raise StorageError(
                f"{self._file.name}: the truth cannot be written: {error.strerror}; make room, or name "
                "another file by --truth"
            ) from error
        self._next_ns = int(stamps_ns[-1]) + TRUTH_STEP_NS


def _run(options: argparse.Namespace) -> int:
    stopping = {signal.SIGTERM, signal.SIGINT}
    signal.pthread_sigmask(signal.SIG_BLOCK, stopping)  # before any thread: they inherit it
    parent = os.getppid()
    world = build_world(options.world)
    warm_up(world)  # before the ride begins
    ride = Ride(world, time.monotonic_ns(), options.stand_s)
    vehicle = FakeVehicle(options.device, ride, options.seed)
    if options.faults is not None:
        faults = read_faults(options.faults, vehicle.devices)
        vehicle.afflict(faults, options.seed, ride.start_ns)
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    with open(options.truth or os.devnull, "wb", buffering=0) as truth_file, vehicle:
        truth = TruthFile(ride, truth_file)
        _announce(vehicle, options.print_endpoints)
        facts: Counter[tuple[str, str]] = Counter()
        report_at_s = time.monotonic() + REPORT_S
        while signal.sigtimedwait(stopping, LOOK_S) is None:
            truth.write_until(time.monotonic_ns())
            if time.monotonic() >= report_at_s:
                warn_of_losses(vehicle, facts)
                report_at_s = time.monotonic() + REPORT_S
            if vehicle.failed:
                return FAILED
            if options.die_with_parent and os.getppid() != parent:
                log.info("parent process %d has gone; ending", parent)
                break
        truth.write_until(time.monotonic_ns())
        warn_of_losses(vehicle, facts)
        if options.print_endpoints:
            losses = {name: sum(counts.values()) for name, counts in vehicle.losses().items()}
            print(json.dumps({"left_out": {name: n for name, n in losses.items() if n}}), flush=True)
    for name, counters in vehicle.fault_counters().items():
        log.info("%s had %s", name, ", ".join(f"{count} {what}" for what, count in counters.items()))
    return DONE


def warn_of_losses(vehicle: FakeVehicle, facts: Counter[tuple[str, str]]) -> None:
    """Warn of measurements and messages that the simulation lost since the last report."""
    for name, losses in vehicle.losses().items():
        for what, count in losses.items():
            if count > facts[name, what]:
                more = count - facts[name, what]
                log.warning("%s: %d more %s; is this machine overloaded?", name, more, what)
                facts[name, what] = count


def _announce(vehicle: FakeVehicle, on_stdout: bool) -> None:
    for line in vehicle.endpoints():
        if on_stdout:
            print(json.dumps(line), flush=True)
        else:
            log.info("%(name)s: %(device)s at %(endpoint)s", line)
    if on_stdout:
        print(json.dumps({"ready": True}), flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parse(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        return _run(options)
    except (ConfigError, StorageError) as error:
        log.error("corridor: %s", error)
        return error.exit_code
    except OSError as error:
        reason = error.strerror or str(error)
        log.error("corridor: %s", f"{error.filename}: {reason}" if error.filename else reason)
        return IO_ERROR
