"""A good drive, ways to spoil its times, and what the mapper makes of it behind a Timing."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from drivers.frames import Frame, ImuSample, LaserScan, OdometrySample
from service.geometry.se2 import SE2
from service.mapper.mapping_session import MappingSession
from service.mapper.profiles import build_mapper, mapping_config
from service.timing import Timing
from simulators.truth import LMS100
from simulators.worlds import build_world
from tests.simulated import FORWARD, Imu, Laser, Wheels, drive

S = 1_000_000_000
KINDS: dict[str, type[Frame]] = {"scan": LaserScan, "odom": OdometrySample, "imu": ImuSample}
TOPICS = {"scan": "/front/scan", "odom": "/base/odom", "imu": "/imu/imu"}
BEGAN_NS = 1_700_000_000 * S + 123_456_789
SLOW_LASER = Laser(LMS100, 136, 10.0, -135.0, 2.0)  # a wrong time_increment shows in what it sees in a turn
Damage = Callable[[int, Any], Any]  # position among the frames of its topic, frame -> frame


@dataclass(frozen=True)
class Mapped:
    """What came of a drive.

    error_m   RMS of the positions against the truth after the best rigid motion, by log times of the scans
    """

    stamps_ns: list[int]
    poses: list[SE2]
    error_m: float
    warnings: list[str]
    counters: Counter[str]
    dropped: dict[str, int]  # by kind


@cache
def good_drive() -> tuple[Sequence[Frame], dict[int, SE2]]:
    """Frames by log time, and where the base was at each scan, by its log time."""
    made = drive(build_world("office"), SLOW_LASER, 9.0, 3, Wheels(), Imu())
    truth = {f.arrived_ns + BEGAN_NS: made.truth[f.stamp_ns] for f in made.frames if isinstance(f, LaserScan)}
    return [moved(f, BEGAN_NS, BEGAN_NS) for f in made.frames], truth


def moved(frame: Any, stamp_ns: int, arrived_ns: int = 0) -> Any:
    """The frame so much later."""
    return replace(frame, stamp_ns=frame.stamp_ns + stamp_ns, arrived_ns=frame.arrived_ns + arrived_ns)


def damaged(kind: str, damage: Damage) -> list[Frame]:
    """The good drive with the frames of one topic damaged; log times stay right."""
    count = 0
    frames = []
    for frame in good_drive()[0]:
        if isinstance(frame, KINDS[kind]):
            frames.append(damage(count, frame))
            count += 1
        else:
            frames.append(frame)
    return frames


def without(*kinds: str) -> list[Frame]:
    """The good drive without some topics."""
    return [frame for frame in good_drive()[0] if not isinstance(frame, tuple(KINDS[kind] for kind in kinds))]


def mapped(frames: Sequence[Frame]) -> Mapped:
    """By the default profile, as a replay maps them."""
    session = MappingSession(lambda: build_mapper(mapping_config(), {"front": FORWARD}), ["front"])
    timing = Timing(["front"], session.counters)
    stamps, poses, logs = [], [], []
    taken: Counter[type] = Counter()
    for frame in [*frames, None]:
        released = timing.finish() if frame is None else timing.take(frame)
        for one, _ in released:
            taken[type(one)] += 1
            if (output := session.process(one)) is not None:
                heading_rad = output.pose_odom_base.theta_rad if output.state != "lost" else math.nan
                timing.mapped(one, output.stamp_ns, heading_rad)
                stamps.append(output.stamp_ns)
                poses.append(output.pose_map_base)
                logs.append(one.arrived_ns)
    session.close()
    given = Counter(type(frame) for frame in frames)
    dropped = {kind: given[of] - taken[of] for kind, of in KINDS.items()}
    return Mapped(stamps, poses, _error_m(poses, logs), timing.warnings, session.counters, dropped)


def _error_m(poses: Sequence[SE2], log_ns: Sequence[int]) -> float:
    if len(poses) < 3:
        return math.inf
    truth = good_drive()[1]
    return aligned_rms_m(poses, [truth[at] for at in log_ns])


def aligned_rms_m(poses: Sequence[SE2], truth: Sequence[SE2]) -> float:
    """Of the positions, after the rigid motion that fits best."""
    found, true = (np.array([(pose.x_m, pose.y_m) for pose in some]) for some in (poses, truth))
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    u, _, vt = np.linalg.svd(found.T @ true)
    turn = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt(((found @ turn - true) ** 2).sum(axis=1).mean()))
