"""Imports ROS 1 and ROS 2 bags: laser scans, odometry, inertial samples and fixes, with their mountings."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.counted import counted
from drivers.frames import Frame, GnssFix, ImuSample, LaserScan, OdometrySample
from service.errors import InputError
from service.geometry.se2 import SE2
from service.mapper.mapping_session import Step
from service.offline.importing.session_file import refuse_to_overwrite, write_session
from service.offline.writing import refuse_unwritable_file
from service.recording.choice import NO_CHOICE, Choice
from service.recording.mcap_source import Session, open_session

MAX_STAMP_NS = 2**31 * 1_000_000_000  # ROS messages count seconds in int32
SEVERAL = {  # kinds of frames
    LaserScan: "scans",
    OdometrySample: "odometry samples",
    ImuSample: "IMU samples",
    GnssFix: "fixes",
}
ONE = {"scans": "scan", "odometry samples": "odometry sample", "IMU samples": "IMU sample", "fixes": "fix"}


@dataclass(slots=True)
class BagReport:
    """What was found in a bag, and what was imported."""

    source: Path
    path: Path
    frames: Counter[str] = field(default_factory=Counter)  # "scans of front" and the like
    unusable: int = 0  # messages no mapper can use
    mountings: dict[str, SE2] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)  # as Session.losses
    duration_s: float = 0.0

    def __str__(self) -> str:
        counts = []
        for what, count in sorted(self.frames.items()):
            kind, _, sensor = what.partition(" of ")
            counts.append(f"{counted(count, ONE[kind], kind)} of {sensor}")
        unusable = [f"unusable for mapping: {counted(self.unusable, 'message')}"] if self.unusable else []
        found = f"{self.path}: {', '.join(counts)} over {self.duration_s:.1f} s"
        return "\n".join([found, *self.notes, *unusable, *self.losses])


def import_rosbag(bag_path: Path, out_path: Path, choice: Choice = NO_CHOICE) -> BagReport:
    """Turn a bag into a session: /<sensor>/scan, odom, imu, fix and /tf_static, at the times of the bag.

    bag_path   see recording.opening
    choice     topics and frames, where they are not left to be found

    Sensors are chosen and named as in a replay of a foreign recording; mountings are those of /tf_static,
    or of edges of /tf that never change. Raises InputError for what is no such bag, holds no laser that can
    be mapped or not one beam that came back, UsageError where out_path is the bag itself, StorageError when
    writing fails.
    """
    refuse_to_overwrite(bag_path, out_path)
    refuse_unwritable_file(out_path)
    report = BagReport(bag_path, out_path)
    session = open_session([bag_path], choice)
    known = {name: pose for name, pose in session.mountings.items() if name not in session.unmounted}
    report.mountings = known | session.antennas
    report.notes = [*session.notes, *session.warnings, *session.unmounted.values()]
    scans = (frame for frame in _usable(session) if isinstance(frame, LaserScan))
    if not any(np.isfinite(scan.range_m).any() for scan in scans):
        raise InputError(
            f"{bag_path}: not one beam came back in all scans of "
            f"{' and '.join(sorted(session.mountings))}; nothing can be mapped of it"
            + "".join(f"; {loss}" for loss in session.losses)
        )
    about = {"source": bag_path.name, "format": "rosbag", "notes": "\n".join(report.notes)}
    write_session(out_path, _counted(session, report), report.mountings, about, log_times=True)
    report.losses = session.losses
    report.unusable = sum(count for what, count in session.counters.items() if what.endswith(" unusable"))
    return report


def _usable(session: Session) -> Iterator[Frame]:
    """Frames whose stamps a ROS message can represent; others are counted as unusable."""
    for step in session.steps():
        if isinstance(step, Step):
            continue
        if 0 <= step.stamp_ns < MAX_STAMP_NS and 0 <= step.arrived_ns < MAX_STAMP_NS:
            yield step
        else:
            session.counters[f"{step.sensor} stamps unusable"] += 1


def _counted(session: Session, report: BagReport) -> Iterator[Frame]:
    first_ns = None
    for frame in _usable(session):
        first_ns = frame.arrived_ns if first_ns is None else first_ns
        report.duration_s = (frame.arrived_ns - first_ns) / 1e9
        report.frames[f"{SEVERAL[type(frame)]} of {frame.sensor}"] += 1
        yield frame
