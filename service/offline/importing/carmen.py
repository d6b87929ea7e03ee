"""Imports CARMEN logs and their relatives as sessions.

Many published logs are "corrected": their poses are the result of someone's SLAM. Those never become
odometry unless requested.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from drivers.counted import counted
from drivers.frames import Frame, OdometrySample
from service.geometry.se2 import SE2, wrap_angle
from service.offline.importing.carmen_log import Log, LoggedOdometry, LoggedScan, read_log
from service.offline.importing.session_file import refuse_to_overwrite, write_session
from service.offline.writing import refuse_unwritable_file

OdometryChoice = Literal["auto", "logged", "none"]
RIGID_M, RIGID_RAD = 0.02, math.radians(1.0)  # how constant laser against robot must be to be a mounting
CORRECTED_MARKS = {"NEFF": "GMapping's NEFF lines", "SM_UPDATE": "GMapping's SM_UPDATE lines"}


@dataclass(slots=True)
class ImportReport:
    """What was found in a log, and what was imported."""

    source: Path
    path: Path
    scans: Counter[str] = field(default_factory=Counter)  # by sensor
    odometry: int = 0
    odometry_source: str = "none"
    corrected: str = ""  # why the log is taken for a corrected one, or ""
    malformed: Counter[str] = field(default_factory=Counter)  # by line type; skipped
    ignored: Counter[str] = field(default_factory=Counter)  # line types without data for a mapper
    out_of_order: int = 0  # lines whose stamp lay before that of the line above; put in order
    most_back_s: float = 0.0  # ... by so much
    mountings: dict[str, SE2] = field(default_factory=dict)
    duration_s: float = 0.0

    def __str__(self) -> str:
        scans = ", ".join(
            f"{counted(count, 'scan')} of {sensor}" for sensor, count in sorted(self.scans.items())
        )
        lines = [
            f"{self.path}: {scans}, {counted(self.odometry, 'odometry sample')} over {self.duration_s:.1f} s"
        ]
        if self.corrected:
            name = f"{self.source.name} is a corrected log ({self.corrected})"
            lines.append(f"{name}: the poses of its scans are a result, not odometry")
        lines.append(f"odometry: {self.odometry_source}")
        if self.malformed:
            lines.append(f"skipped as malformed: {_listed(self.malformed)}")
        if self.ignored:
            lines.append(f"not used: {_listed(self.ignored)}")
        if self.out_of_order:
            back = f"{counted(self.out_of_order, 'line')}, by up to {self.most_back_s:.2f} s"
            lines.append(f"put in the order of their stamps: {back}")
        return "\n".join(lines)


def _listed(counts: Counter[str]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in sorted(counts.items()))


def import_carmen(log_path: Path, out_path: Path, odometry: OdometryChoice = "auto") -> ImportReport:
    """Turn a log into a session: /front/scan, /rear/scan, /base/odom, /tf_static, in the log's own time.

    odometry    "auto": from ODOM lines, else from the odometry of the scans; of a corrected log only what is
                odometry. "logged": the poses as they stand, corrected or not. "none": leave it out.
    Raises InputError for a file that is no such log, has no usable time or no beam that came back, UsageError
    where out_path is the log itself, StorageError when writing fails.
    """
    refuse_to_overwrite(log_path, out_path)
    refuse_unwritable_file(out_path)
    log = read_log(log_path)
    report = ImportReport(
        log_path,
        out_path,
        malformed=log.malformed,
        ignored=log.ignored,
        out_of_order=log.out_of_order,
        most_back_s=log.most_back_s,
    )
    report.corrected = _why_corrected(log, log_path)
    samples = _odometry_of(log, odometry, report)
    report.scans.update(scan.frame.sensor for scan in log.scans)
    for sensor in sorted(report.scans):
        report.mountings[sensor] = _mounting(log, sensor, bool(report.corrected))
    frames: list[Frame] = [*samples, *(scan.frame for scan in log.scans)]
    frames.sort(key=lambda frame: frame.stamp_ns)  # at equal stamps odometry comes first
    report.odometry = len(samples)
    report.duration_s = (frames[-1].stamp_ns - frames[0].stamp_ns) / 1e9
    about = {
        "source": report.source.name,
        "format": "carmen",
        "corrected": report.corrected,
        "odometry": report.odometry_source,
    }
    write_session(report.path, frames, report.mountings, about)
    return report


def _why_corrected(log: Log, path: Path) -> str:
    """Why the log is a corrected one, or ""."""
    reasons = [mark for kind, mark in CORRECTED_MARKS.items() if log.ignored[kind]]
    restated = sum(not sample.stamp_ns for sample in log.odometry)
    if restated > len(log.scans) // 2:
        reasons.append(f"{counted(restated, 'ODOM line')} without a time, restating the poses of scans")
    if "corrected" in path.name.lower():
        reasons.append("its name")
    if not _is_rigid(log.scans):
        reasons.append("the laser moves against the robot")
    return ", ".join(reasons)


def _is_rigid(scans: Sequence[LoggedScan]) -> bool:
    """Whether the laser keeps its place on the robot; where it does not, its pose was corrected."""
    for sensor in {scan.frame.sensor for scan in scans}:
        relative = _laser_poses(scans, sensor)
        middle = _median(relative)
        off = [
            math.hypot(p.x_m - middle.x_m, p.y_m - middle.y_m) > RIGID_M
            or abs(wrap_angle(p.theta_rad - middle.theta_rad)) > RIGID_RAD
            for p in relative
        ]
        if sum(off) > len(off) // 10:
            return False
    return True


def _laser_poses(scans: Sequence[LoggedScan], sensor: str) -> list[SE2]:
    """Poses of that laser on the robot, scan by scan."""
    return [s.pose_robot.between(s.pose_laser) for s in scans if s.frame.sensor == sensor]


def _median(poses: Sequence[SE2]) -> SE2:
    turned = [wrap_angle(pose.theta_rad - poses[0].theta_rad) for pose in poses]
    return SE2(
        float(np.median([pose.x_m for pose in poses])),
        float(np.median([pose.y_m for pose in poses])),
        wrap_angle(poses[0].theta_rad + float(np.median(turned))),
    )


def _mounting(log: Log, sensor: str, corrected: bool) -> SE2:
    """Mounting by the poses of laser and robot where both are logged, else by PARAM, else at the centre."""
    relative = _median(_laser_poses(log.scans, sensor))
    if not corrected and relative.log() != (0.0, 0.0, 0.0):
        return SE2(round(relative.x_m, 4), round(relative.y_m, 4), round(relative.theta_rad, 6))
    prefix = f"robot_{sensor}laser"
    ahead_m, left_m, turn_rad = (
        float(log.params.get(f"{prefix}_{name}", default))
        for name, default in (
            ("offset", 0.0),
            ("side_offset", 0.0),
            ("angular_offset", math.pi if sensor == "rear" else 0.0),
        )
    )
    return SE2(ahead_m, left_m, wrap_angle(turn_rad))


def _odometry_of(log: Log, choice: OdometryChoice, report: ImportReport) -> list[OdometrySample]:
    timed = [sample for sample in log.odometry if sample.stamp_ns]
    from_scans = [LoggedOdometry(scan.frame.stamp_ns, scan.pose_robot) for scan in log.scans]
    restated = len(timed) < len(log.odometry)
    if choice == "none":
        report.odometry_source = "left out as asked"
        return []
    if choice == "logged":
        report.odometry_source = "the poses of the scans as logged"
        return _samples(from_scans)
    if timed and report.corrected and restated:
        report.odometry_source = (
            f"the increments of {counted(len(timed), 'ODOM line')} between corrections; "
            "where GMapping wrote the log, its motion noise is in them"
        )
        return _samples(_chained(log.odometry))
    if timed:
        report.odometry_source = counted(len(timed), "ODOM line")
        return _samples(timed)
    if not report.corrected:
        report.odometry_source = (
            "the odometry pose of each scan; there are no ODOM lines to tell whether it was corrected"
        )
        return _samples(from_scans)
    if not _is_rigid(log.scans):
        report.odometry_source = "the odometry pose of each scan; its corrected pose is left out"
        return _samples(from_scans)
    report.odometry_source = (
        "none: the log holds corrected poses only; --odometry logged imports them, "
        "but what is mapped with them must not be scored"
    )
    return []


def _chained(logged: Sequence[LoggedOdometry]) -> list[LoggedOdometry]:
    """The motion between corrections, put end to end: a pose without a time starts again without moving."""
    chain, last, result = SE2(), SE2(), []
    for sample in logged:
        if sample.stamp_ns:
            chain = chain @ last.between(sample.pose)
            result.append(LoggedOdometry(sample.stamp_ns, chain, sample.tv_mps, sample.rv_radps))
        last = sample.pose
    return result


def _samples(logged: Sequence[LoggedOdometry]) -> list[OdometrySample]:
    """Twists come from the log, or from the motion since the sample before where the log has only zeros."""
    has_twist = any(sample.tv_mps or sample.rv_radps for sample in logged)
    samples = []
    last: LoggedOdometry | None = None
    for sample in sorted(logged, key=lambda s: s.stamp_ns):
        twist = (sample.tv_mps, 0.0, sample.rv_radps)
        if not has_twist and last is not None and sample.stamp_ns > last.stamp_ns:
            dt_s = (sample.stamp_ns - last.stamp_ns) / 1e9
            forward_m, left_m, turn_rad = last.pose.between(sample.pose).log()
            twist = (forward_m / dt_s, left_m / dt_s, turn_rad / dt_s)
        samples.append(
            OdometrySample(
                sensor="base",
                stamp_ns=sample.stamp_ns,
                arrived_ns=sample.stamp_ns,
                x_m=sample.pose.x_m,
                y_m=sample.pose.y_m,
                theta_rad=wrap_angle(sample.pose.theta_rad),
                twist_mps_radps=twist,
                covariance=(0.0,) * 9,
            )
        )
        last = sample
    return samples
