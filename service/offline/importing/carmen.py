"""Imports CARMEN logs: text, one message a line, plain or gzip; and the two relatives found beside them.

Read are FLASER, RLASER, ROBOTLASER1, ROBOTLASER2, ODOM and PARAM of CARMEN's logger, LASER_READING and ODOM
of GMapping's .gfs, and L and O lines (centimetres) of the logs handed out with CMU's course 16-831.
Sources: the comment lines CARMEN's logger puts at the head of its logs; GMapping's gfsreader and
carmenconfiguration; the course's instruct.txt.

Many published logs are "corrected": their poses are the result of someone's SLAM. Those never become
odometry unless requested.
"""

import gzip
import math
import os
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from io import TextIOWrapper
from pathlib import Path
from typing import IO, Literal

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from drivers.frames import NO_INTENSITY, Frame, LaserScan, OdometrySample
from service.errors import InputError, words_of
from service.geometry.se2 import SE2, wrap_angle
from service.limits import MAX_LINE_BYTES, MAX_LOG_BYTES, Unpacking, check, factor
from service.offline.importing.session_file import refuse_to_overwrite, write_session
from service.offline.writing import refuse_unwritable_file
from service.readable import open_file

GZIP_MAGIC = b"\x1f\x8b"

OdometryChoice = Literal["auto", "logged", "none"]
Ranges = npt.NDArray[np.float32]  # m

FLASER_RANGE_MAX_M = 50.0  # logs cap at 50 m or flag with 81.9 m; FLASER does not state which
SICK_RANGE_MAX_M = 80.0  # SICK flags errors with 81.83 m and more, whatever the line gives as its maximum
RIGID_M, RIGID_RAD = 0.02, math.radians(1.0)  # how constant laser against robot must be to be a mounting
LASERS = {
    "FLASER": "front",
    "RLASER": "rear",
    "ROBOTLASER1": "front",
    "ROBOTLASER2": "rear",
    "LASER_READING": "front",
    "L": "front",
}
PLACE_PARAM = re.compile(r"robot_(front|rear)laser_(|side_|angular_)offset")  # a mounting
FARTHEST_M = 1e6  # from the begin of a log; farther away is damage
MAX_STAMP_S = 2**31  # ROS messages count seconds in int32
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


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    frame: LaserScan
    pose_laser: SE2
    pose_robot: SE2


@dataclass(frozen=True, slots=True)
class _Odometry:
    stamp_ns: int  # 0: GMapping repeats the corrected pose of the scan above
    pose: SE2
    tv_mps: float = 0.0
    rv_radps: float = 0.0


@dataclass(slots=True)
class _Log:
    """A log as it stands, in the order of its lines."""

    scans: list[_Scan] = field(default_factory=list)
    odometry: list[_Odometry] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)
    kinds: Counter[str] = field(default_factory=Counter)
    scan_above: _Scan | None = None  # the scan on the line before


def import_carmen(log_path: Path, out_path: Path, odometry: OdometryChoice = "auto") -> ImportReport:
    """Turn a log into a session: /front/scan, /rear/scan, /base/odom, /tf_static, in the log's own time.

    odometry    "auto": from ODOM lines, else from the odometry of the scans; of a corrected log only what is
                odometry. "logged": the poses as they stand, corrected or not. "none": leave it out.
    Raises InputError for a file that is no such log, has no usable time or no beam that came back, UsageError
    where out_path is the log itself, StorageError when writing fails.
    """
    refuse_to_overwrite(log_path, out_path)
    refuse_unwritable_file(out_path)
    report = ImportReport(log_path, out_path)
    log = _read(log_path, report)
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


def _read(path: Path, report: ImportReport) -> _Log:
    log, first_line, last_ns = _Log(), "", 0
    try:
        with open_file(path) as file:
            zipped = file.peek(2)[:2] == GZIP_MAGIC
            unpacking = Unpacking(path, os.fstat(file.fileno()).st_size)
            content = gzip.GzipFile(fileobj=file) if zipped else file
            stream = TextIOWrapper(content, encoding="latin-1")
            for line in _lines(path, stream, unpacking):
                first_line = first_line or line.strip()[:60]
                fields = line.split()
                try:
                    stamp_ns = _take(log, fields, report)
                except (ValueError, IndexError, ArithmeticError):
                    report.malformed[fields[0][:20]] += 1
                    continue
                if stamp_ns:
                    report.out_of_order += stamp_ns < last_ns
                    report.most_back_s = max(report.most_back_s, (last_ns - stamp_ns) / 1e9)
                    last_ns = stamp_ns
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"cannot read {path}: {words_of(error)}") from error
    if not log.scans:
        raise InputError(
            f"{path} holds no line of {', '.join(LASERS)} that can be read; is it a CARMEN log? "
            f"It begins with {first_line!r}"
        )
    distinct = len({scan.frame.stamp_ns for scan in log.scans})
    if distinct <= len(log.scans) // 2:
        raise InputError(
            f"{path}: {len(log.scans)} scans carry {distinct} different times, so when they were taken is "
            "lost (some logs were written with six digits); look for another copy, such as its .gfs"
        )
    frames = (scan.frame for scan in log.scans)
    if not any(((frame.range_m > 0.0) & (frame.range_m < frame.range_max_m)).any() for frame in frames):
        raise InputError(
            f"{path}: not one beam of {counted(len(log.scans), 'scan')} came back between 0 and "
            f"{log.scans[0].frame.range_max_m:g} m; nothing can be mapped of it"
        )
    return log


def _lines(path: Path, stream: IO[str], unpacking: Unpacking) -> Iterator[str]:
    longest, total = round(MAX_LINE_BYTES * factor()), 0
    limit = min(unpacking.left, round(MAX_LOG_BYTES * factor()))
    while line := stream.readline(longest + 1):
        total += len(line)
        if len(line) > longest or total > limit:
            check(len(line), MAX_LINE_BYTES, f"{path}: a line")
            check(total, MAX_LOG_BYTES, f"{path}: the log")
            unpacking.take(total)
        if line.strip() and not line.startswith("#"):
            yield line


def _take(log: _Log, fields: list[str], report: ImportReport) -> int:
    """Take in one line; its stamp, or 0 where it has none.

    Raises ValueError, IndexError, ArithmeticError for a line that is not as it should be.
    """
    kind, above, log.scan_above = fields[0], log.scan_above, None
    match kind:
        case "FLASER" | "RLASER":
            scan = _flaser(fields)
        case "ROBOTLASER1" | "ROBOTLASER2":
            scan = _robotlaser(fields)
        case "LASER_READING":
            scan = _laser_reading(fields)
        case "L":
            scan = _l_line(fields)
        case "ODOM" | "O":
            odometry = _o_line(fields) if kind == "O" else _odom(fields, above)
            log.odometry.append(odometry)
            return odometry.stamp_ns
        case "PARAM":
            if PLACE_PARAM.fullmatch(fields[1]):
                _finite(fields[2])
            log.params[fields[1]] = fields[2]
            return 0
        case _:
            log.kinds[kind] += 1
            report.ignored[kind[:20]] += 1
            return 0
    log.scans.append(scan)
    log.scan_above = scan
    return scan.frame.stamp_ns


def _flaser(fields: list[str]) -> _Scan:
    """FLASER n [ranges] laser_x y theta robot_x y theta ipc_timestamp host logger_timestamp"""
    count = int(fields[1])
    ranges, poses = _ranges(fields[2 : 2 + count], count), fields[2 + count : 8 + count]
    frame = _frame(LASERS[fields[0]], fields[8 + count], ranges, _guessed_angles(count), FLASER_RANGE_MAX_M)
    return _Scan(frame, _pose(poses[:3]), _pose(poses[3:]))


def _robotlaser(fields: list[str]) -> _Scan:
    """ROBOTLASERn type start_angle fov resolution max_range accuracy remission_mode n [ranges] m [remissions]
    laser_x y theta robot_x y theta tv rv forward_safety side_safety turn_axis timestamp host logger_timestamp
    """
    start_rad, _, step_rad, max_range_m = map(_finite, fields[2:6])
    count = int(fields[8])
    if not abs(start_rad) <= 2.0 * math.pi or not 0.0 < abs(step_rad) * max(count - 1, 1) < 2.1 * math.pi:
        raise ValueError(f"{counted(count, 'beam')} from {start_rad} rad on, {step_rad} rad apart")
    after = 10 + count + int(fields[9 + count])
    ranges = _ranges(fields[9 : 9 + count], count)
    range_max_m = min(max_range_m, SICK_RANGE_MAX_M) if max_range_m > 0 else SICK_RANGE_MAX_M
    frame = _frame(LASERS[fields[0]], fields[after + 11], ranges, (start_rad, step_rad), range_max_m)
    return _Scan(frame, _pose(fields[after : after + 3]), _pose(fields[after + 3 : after + 6]))


def _laser_reading(fields: list[str]) -> _Scan:
    """LASER_READING n [ranges] x y theta timestamp; the pose is that of the best particle."""
    count = int(fields[1])
    pose, ranges = _pose(fields[2 + count : 5 + count]), _ranges(fields[2 : 2 + count], count)
    frame = _frame("front", fields[5 + count], ranges, _guessed_angles(count), FLASER_RANGE_MAX_M)
    return _Scan(frame, pose, pose)


def _l_line(fields: list[str]) -> _Scan:
    """L robot_x y theta laser_x y theta [180 ranges] timestamp; centimetres and radians."""
    count = len(fields) - 8
    ranges = _ranges(fields[7 : 7 + count], count) * np.float32(0.01)
    frame = _frame("front", fields[-1], ranges, _guessed_angles(count), SICK_RANGE_MAX_M)
    return _Scan(frame, pose_laser=_pose(fields[4:7], 0.01), pose_robot=_pose(fields[1:4], 0.01))


def _frame(
    sensor: str, stamp: str, ranges: Ranges, angles_rad: tuple[float, float], range_max_m: float
) -> LaserScan:
    """A scan of these first angle and step. CARMEN logs no times of beams, so a sweep is one instant."""
    stamp_ns = _ns(stamp)
    return LaserScan(
        sensor=sensor,
        stamp_ns=stamp_ns,
        arrived_ns=stamp_ns,
        beam_interval_ns=0,
        scan_period_ns=0,
        first_angle_rad=angles_rad[0],
        angle_step_rad=angles_rad[1],
        range_min_m=0.0,
        range_max_m=range_max_m,
        range_m=ranges,
        intensity=NO_INTENSITY,
    )


def _odom(fields: list[str], above: _Scan | None) -> _Odometry:
    """CARMEN: ODOM x y theta tv rv accel ipc_timestamp host logger_timestamp. GMapping: ODOM x y theta time

    GMapping writes a corrected pose twice, in the scan and in an ODOM line below it, whose time is 0 or
    whatever lay in memory.
    """
    pose = _pose(fields[1:4])
    if len(fields) == 5:
        return _Odometry(_ns(fields[4]), pose)
    if above is not None and pose == above.pose_robot and _restates(fields[7], above):
        return _Odometry(0, pose)
    return _Odometry(_ns(fields[7]), pose, _finite(fields[4]), _finite(fields[5]))


def _restates(text: str, above: _Scan) -> bool:
    """Whether a stamp is none of its own: before that of the scan above."""
    stamp_s = Decimal(text)
    return stamp_s.is_finite() and stamp_s < Decimal(above.frame.stamp_ns).scaleb(-9)


def _o_line(fields: list[str]) -> _Odometry:
    """O x y theta timestamp; centimetres and radians."""
    return _Odometry(_ns(fields[4]), _pose(fields[1:4], 0.01))


def _guessed_angles(count: int) -> tuple[float, float]:
    """First angle and step of a laser that only states how many beams it has.

    180 or 181 beams are 1 deg apart, 360 or 361 0.5 deg, from -90 deg on; 401 are the 100 deg mode of the
    SICK LMS with 0.25 deg. Any other number is taken to span 180 deg evenly, both ends included.
    """
    if count < 2:
        raise ValueError(counted(count, "beam"))
    known = {180: (-90.0, 1.0), 181: (-90.0, 1.0), 360: (-90.0, 0.5), 361: (-90.0, 0.5), 401: (-50.0, 0.25)}
    first_deg, step_deg = known.get(count, (-90.0, 180.0 / (count - 1)))
    return math.radians(first_deg), math.radians(step_deg)


def _ranges(texts: Sequence[str], count: int) -> Ranges:
    if len(texts) != count:
        raise ValueError(f"{counted(len(texts), 'range')} instead of {count}")
    with np.errstate(over="ignore"):  # what no float32 holds lies beyond every laser: no return
        return np.array([float(text) for text in texts]).astype(np.float32)


def _pose(texts: Sequence[str], unit_m: float = 1.0) -> SE2:
    x, y, theta_rad = map(_finite, texts)
    if max(abs(x * unit_m), abs(y * unit_m), abs(theta_rad)) > FARTHEST_M:
        raise ValueError(f"pose {x}, {y}, {theta_rad}")
    return SE2(x * unit_m, y * unit_m, theta_rad)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not finite")
    return value


def _ns(text: str) -> int:
    """Seconds as text to ns, exactly: a double holds today's Unix time to 0.2 us only."""
    seconds = Decimal(text)
    if not seconds.is_finite() or not 0 <= seconds < MAX_STAMP_S:
        raise ValueError(f"time {text}")
    return int(seconds.scaleb(9))


def _why_corrected(log: _Log, path: Path) -> str:
    """Why the log is a corrected one, or ""."""
    reasons = [mark for kind, mark in CORRECTED_MARKS.items() if log.kinds[kind]]
    restated = sum(not sample.stamp_ns for sample in log.odometry)
    if restated > len(log.scans) // 2:
        reasons.append(f"{counted(restated, 'ODOM line')} without a time, restating the poses of scans")
    if "corrected" in path.name.lower():
        reasons.append("its name")
    if not _is_rigid(log.scans):
        reasons.append("the laser moves against the robot")
    return ", ".join(reasons)


def _is_rigid(scans: Sequence[_Scan]) -> bool:
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


def _laser_poses(scans: Sequence[_Scan], sensor: str) -> list[SE2]:
    """Poses of that laser on the robot, scan by scan."""
    return [s.pose_robot.inverse() @ s.pose_laser for s in scans if s.frame.sensor == sensor]


def _median(poses: Sequence[SE2]) -> SE2:
    turned = [wrap_angle(pose.theta_rad - poses[0].theta_rad) for pose in poses]
    return SE2(
        float(np.median([pose.x_m for pose in poses])),
        float(np.median([pose.y_m for pose in poses])),
        wrap_angle(poses[0].theta_rad + float(np.median(turned))),
    )


def _mounting(log: _Log, sensor: str, corrected: bool) -> SE2:
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


def _odometry_of(log: _Log, choice: OdometryChoice, report: ImportReport) -> list[OdometrySample]:
    timed = [sample for sample in log.odometry if sample.stamp_ns]
    from_scans = [_Odometry(scan.frame.stamp_ns, scan.pose_robot) for scan in log.scans]
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


def _chained(logged: Sequence[_Odometry]) -> list[_Odometry]:
    """The motion between corrections, put end to end: a pose without a time starts again without moving."""
    chain, last, result = SE2(), SE2(), []
    for sample in logged:
        if sample.stamp_ns:
            chain = chain @ (last.inverse() @ sample.pose)
            result.append(_Odometry(sample.stamp_ns, chain, sample.tv_mps, sample.rv_radps))
        last = sample.pose
    return result


def _samples(logged: Sequence[_Odometry]) -> list[OdometrySample]:
    """Twists come from the log, or from the motion since the sample before where the log has only zeros."""
    has_twist = any(sample.tv_mps or sample.rv_radps for sample in logged)
    samples = []
    last: _Odometry | None = None
    for sample in sorted(logged, key=lambda s: s.stamp_ns):
        twist = (sample.tv_mps, 0.0, sample.rv_radps)
        if not has_twist and last is not None and sample.stamp_ns > last.stamp_ns:
            dt_s = (sample.stamp_ns - last.stamp_ns) / 1e9
            forward_m, left_m, turn_rad = (last.pose.inverse() @ sample.pose).log()
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
