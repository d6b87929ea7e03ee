"""Accuracy of several lasers, also with a wrong mounting or a laser that stops."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.frames import Frame, LaserScan
from service.geometry.poses import compose
from service.geometry.se2 import SE2
from service.mapper.corrections import corrected
from service.mapper.profiles import build_mapper, mapping_config
from service.offline.score.score import align
from simulators.truth import IBEO_LUX, Ride
from simulators.worlds import WORLDS
from tests.accuracy.driving import WHEELS, poses_of
from tests.papers.report import Row, Section
from tests.simulated import LMS100_50HZ, UTM30LX_40HZ, Laser, odometry, scans

FRONT = LMS100_50HZ
REAR = replace(UTM30LX_40HZ, name="rear", mounting=SE2(-0.2, 0.0, math.pi))
LUX = Laser(IBEO_LUX, 220, 25.0, -50.0, 0.5, SE2(0.25, 0.0, 0.0), "lux")
ALL = (FRONT, REAR, LUX)
HALF = 0.5  # of the drive, after which a laser stops or repeats its scan
WRONG_YAW_RAD = math.radians(5.0)

Tamper = Callable[[list[Frame]], list[Frame]]


@dataclass(frozen=True)
class Outcome:
    """Of one run."""

    ate_mm: float  # after the finish
    worst_mm: float
    lost_percent: float
    wrong_ok: int  # scans `ok` and 0.3 m off
    scan_ms: float  # p50, processor time


def frames_of(ride: Ride, lasers: Sequence[Laser], seconds: float, seed: int) -> list[Frame]:
    """In the order of their arrival."""
    frames: list[Frame] = [*odometry(ride, WHEELS, seconds, seed)]
    for laser in lasers:
        frames += scans(ride, laser, seconds, [seed])[0]
    return sorted(frames, key=lambda frame: (frame.arrived_ns, frame.sensor))


def outcome(ride: Ride, frames: Sequence[Frame], mountings: dict[str, SE2]) -> Outcome:
    mapper = build_mapper(mapping_config(), mountings)
    outputs, took_ms = [], []
    for frame in frames:
        began_ns = time.thread_time_ns()
        if (output := mapper.process(frame)) is not None:
            outputs.append(output)
            took_ms.append((time.thread_time_ns() - began_ns) / 1e6)
    finished = corrected(outputs, mapper.finish().corrections)
    truth = poses_of([ride.pose(output.stamp_ns) for output in outputs])

    def off_m(poses: Sequence[SE2]) -> np.ndarray:  # type: ignore[type-arg]
        estimate = poses_of(poses)
        off = compose(align(estimate, truth), estimate) - truth
        return np.hypot(off[:, 0], off[:, 1])

    live_m, off = off_m([output.pose_map_base for output in outputs]), off_m(finished)
    states = [output.state for output in outputs]
    return Outcome(
        1e3 * float(np.sqrt((off**2).mean())),
        1e3 * float(off.max()),
        100.0 * float(np.mean([state == "lost" for state in states])),
        sum(state == "ok" and far > 0.3 for state, far in zip(states, live_m, strict=True)),
        float(np.median(took_ms)),
    )


def _after(half_ns: int, rear: Callable[[LaserScan, list[LaserScan]], Frame | None]) -> Tamper:
    def tamper(frames: list[Frame]) -> list[Frame]:
        tampered: list[Frame | None] = []
        rear_scans: list[LaserScan] = []
        for frame in frames:
            if isinstance(frame, LaserScan) and frame.sensor == "rear" and frame.stamp_ns > half_ns:
                rear_scans.append(frame)
                tampered.append(rear(frame, rear_scans))
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
        off = mountings | {
            one: mountings[one] @ SE2(0.016, -0.012, math.radians(0.25)) for one in ("rear", "lux")
        }
        reversed_rear = mountings | {"rear": mountings["rear"] @ SE2(0.0, 0.0, math.pi)}
        cases: list[tuple[str, Sequence[Laser], dict[str, SE2], Tamper | None]] = [
            ("front", (FRONT,), mountings, None),
            ("rear", (REAR,), mountings, None),
            ("front, rear and LUX", ALL, mountings, None),
            ("the same, rear and LUX 2 cm and 0.25 deg off their mountings", ALL, off, None),
            ("the same, rear stops at the half", ALL, mountings, _after(half_ns, lambda scan, since: None)),
            (
                "the same, rear repeats its scan from the half on",
                ALL,
                mountings,
                _after(half_ns, lambda scan, since: replace(scan, range_m=since[0].range_m)),
            ),
            ("the same, rear turned by 5 deg against its mounting", ALL, wrong, None),
            ("the same, rear turned by 180 deg against its mounting", ALL, reversed_rear, None),
        ]
        for what, ridden, mounted, tamper in cases:
            done = []
            for seed in seeds:
                frames = frames_of(ride, ridden, seconds, seed)
                done.append(outcome(ride, tamper(frames) if tamper else frames, mounted))
            rows += [
                Row(f"{what}: ATE", [o.ate_mm for o in done], "mm", world_name),
                Row(f"{what}: farthest", [o.worst_mm for o in done], "mm", world_name),
                Row(
                    f"{what}: `ok` and 0.3 m off",
                    [float(o.wrong_ok) for o in done],
                    "scans",
                    world_name,
                    at_most=0,
                    by_worst=True,
                ),
                Row(f"{what}: a scan, p50", [o.scan_ms for o in done], "ms", world_name),
            ]
    return Section(
        "Several lasers",
        "LMS-100 at 50 Hz ahead, UTM-30LX at 40 Hz behind, LUX at 25 Hz ahead; odometry; after the finish. "
        "Seeds from 11.",
        rows,
    )
