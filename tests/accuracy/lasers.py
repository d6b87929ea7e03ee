"""Several lasers: better than the best alone, and none the worse for a wrong mounting or a dead one."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from drivers.frames import Frame, LaserScan
from service.geometry.se2 import SE2
from service.mapper.profiles import mapping_config
from simulators.truth import IBEO_LUX, Ride
from simulators.worlds import WORLDS
from tests.accuracy.driving import WHEELS, Errors
from tests.papers.report import Row, Section
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ, Drive, Laser, odometry, run, scans

FRONT = LMS100_50HZ
REAR = replace(UTM30LX_40HZ, name="rear", mounting=SE2(-0.2, 0.0, math.pi))
LUX = Laser(IBEO_LUX, 220, 25.0, -50.0, 0.5, SE2(0.25, 0.0, 0.0), "lux")
ALL = (FRONT, REAR, LUX)
HALF = 0.5  # of the drive, after which a laser dies or hangs
WRONG_YAW_RAD = math.radians(5.0)

Tamper = Callable[[list[Frame]], list[Frame]]


class Truth(dict[int, SE2]):
    """Where the base was at any moment, seen from the first scan."""

    def __init__(self, ride: Ride, first_ns: int) -> None:
        self._ride, self._first = ride, ride.pose(first_ns)

    def __missing__(self, stamp_ns: int) -> SE2:
        return self._first.inverse() @ self._ride.pose(stamp_ns)


def frames_of(ride: Ride, lasers: Sequence[Laser], seconds: float, seed: int) -> list[Frame]:
    """In the order of their arrival."""
    frames: list[Frame] = [*odometry(ride, WHEELS, seconds, seed)]
    for laser in lasers:
        frames += scans(ride, laser, seconds, [seed])[0]
    return sorted(frames, key=lambda frame: (frame.arrived_ns, frame.sensor))


def _after(half_ns: int, rear: Callable[[LaserScan, list[LaserScan]], Frame | None]) -> Tamper:
    def tamper(frames: list[Frame]) -> list[Frame]:
        tampered: list[Frame | None] = []
        held: list[LaserScan] = []
        for frame in frames:
            if isinstance(frame, LaserScan) and frame.sensor == "rear" and frame.stamp_ns > half_ns:
                held.append(frame)
                tampered.append(rear(frame, held))
            else:
                tampered.append(frame)
        return [frame for frame in tampered if frame is not None]

    return tamper


def lasers(seeds: Sequence[int]) -> Section:
    rows = []
    for world_name in ("office", "corridor100", "ring"):
        world = WORLDS[world_name]()
        ride, seconds = Ride(world, 0, 0.5), world.drive.duration_s
        half_ns = round(HALF * seconds * 1e9)
        mountings = {laser.name: laser.mounting for laser in ALL}
        wrong = mountings | {"rear": SE2(-0.2, 0.0, math.pi + WRONG_YAW_RAD)}
        reversed_rear = mountings | {"rear": mountings["rear"] @ SE2(0.0, 0.0, math.pi)}
        dies = _after(half_ns, lambda scan, held: None)
        hangs = _after(half_ns, lambda scan, held: replace(scan, range_m=held[0].range_m))
        cases: list[tuple[str, Sequence[Laser], dict[str, SE2], Tamper | None]] = [
            ("front", (FRONT,), mountings, None),
            ("rear", (REAR,), mountings, None),
            ("front, rear and LUX", ALL, mountings, None),
            ("the same, rear dies half-way", ALL, mountings, dies),
            ("the same, rear hangs half-way", ALL, mountings, hangs),
            ("the same, rear turned by 5 deg against its mounting", ALL, wrong, None),
            ("the same, rear turned by 180 deg against its mounting", ALL, reversed_rear, None),
        ]
        for what, ridden, mounted, tamper in cases:
            errors, wrong, scan_ms = Errors(), [], []
            for seed in seeds:
                frames = frames_of(ride, ridden, seconds, seed)
                first_ns = next(frame.stamp_ns for frame in frames if isinstance(frame, LaserScan))
                made = Drive(tamper(frames) if tamper else frames, Truth(ride, first_ns))
                done = run(mapping_config(), made, mounted)
                errors.add(made, done)
                is_ok = np.array([output.state == "ok" for output in done.outputs])
                wrong.append(float(np.sum(is_ok & (np.hypot(*done.errors[:, :2].T) > 0.3))))
                scan_ms.append(float(np.median(done.scan_ms)))
            case = f"{world_name}, {what}"
            rows += [
                *errors.rows(case, "finished_mm", "as_is_mm"),
                Row("", f"{case}: `ok` and 0.3 m off", wrong, "scans", 0.0, by_worst=True, digits=0),
                Row("", f"{case}: a scan, p50", scan_ms, "ms"),
            ]
    return Section(
        "Several lasers",
        "LMS-100 at 50 Hz ahead, UTM-30LX at 40 Hz behind, LUX at 25 Hz ahead; odometry; after the finish. "
        "Seeds from 11.",
        rows,
    )
