"""Lines of CARMEN logs: text, one message a line, plain or gzip; and of the two relatives found beside them.

Read are FLASER, RLASER, ROBOTLASER1, ROBOTLASER2, ODOM and PARAM of CARMEN's logger, LASER_READING and ODOM
of GMapping's .gfs, and L and O lines (centimetres) of the logs handed out with CMU's course 16-831.
Sources: the comment lines CARMEN's logger puts at the head of its logs; GMapping's gfsreader and
carmenconfiguration; the course's instruct.txt.
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
from typing import IO

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from drivers.frames import NO_INTENSITY, LaserScan
from service.errors import InputError, words_of
from service.geometry.se2 import SE2
from service.limits import MAX_LINE_BYTES, MAX_LOG_BYTES, Unpacking, check, factor
from service.readable import open_file

GZIP_MAGIC = b"\x1f\x8b"

Ranges = npt.NDArray[np.float32]  # m

FLASER_RANGE_MAX_M = 50.0  # logs cap at 50 m or flag with 81.9 m; FLASER does not state which
SICK_RANGE_MAX_M = 80.0  # SICK flags errors with 81.83 m and more, whatever the line gives as its maximum
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


@dataclass(frozen=True, slots=True, eq=False)
class LoggedScan:
    frame: LaserScan
    pose_laser: SE2
    pose_robot: SE2


@dataclass(frozen=True, slots=True)
class LoggedOdometry:
    stamp_ns: int  # 0: GMapping repeats the corrected pose of the scan above
    pose: SE2
    tv_mps: float = 0.0
    rv_radps: float = 0.0


@dataclass(slots=True)
class Log:
    """A log as it stands, in the order of its lines."""

    scans: list[LoggedScan] = field(default_factory=list)
    odometry: list[LoggedOdometry] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)
    malformed: Counter[str] = field(default_factory=Counter)  # by line type; skipped
    ignored: Counter[str] = field(default_factory=Counter)  # line types without data for a mapper
    out_of_order: int = 0  # lines whose stamp lay before that of the line above
    most_back_s: float = 0.0  # ... by so much
    scan_above: LoggedScan | None = None  # the scan on the line before


def read_log(path: Path) -> Log:
    """Raises InputError for a file that is no such log, has no usable time or no beam that came back."""
    log, first_line, last_ns = Log(), "", 0
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
                    stamp_ns = _take(log, fields)
                except (ValueError, IndexError, ArithmeticError):
                    log.malformed[fields[0][:20]] += 1
                    continue
                if stamp_ns:
                    log.out_of_order += stamp_ns < last_ns
                    log.most_back_s = max(log.most_back_s, (last_ns - stamp_ns) / 1e9)
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


def _take(log: Log, fields: list[str]) -> int:
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
            log.ignored[kind[:20]] += 1
            return 0
    log.scans.append(scan)
    log.scan_above = scan
    return scan.frame.stamp_ns


def _flaser(fields: list[str]) -> LoggedScan:
    """FLASER n [ranges] laser_x y theta robot_x y theta ipc_timestamp host logger_timestamp"""
    count = int(fields[1])
    ranges, poses = _ranges(fields[2 : 2 + count], count), fields[2 + count : 8 + count]
    frame = _frame(LASERS[fields[0]], fields[8 + count], ranges, _guessed_angles(count), FLASER_RANGE_MAX_M)
    return LoggedScan(frame, _pose(poses[:3]), _pose(poses[3:]))


def _robotlaser(fields: list[str]) -> LoggedScan:
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
    return LoggedScan(frame, _pose(fields[after : after + 3]), _pose(fields[after + 3 : after + 6]))


def _laser_reading(fields: list[str]) -> LoggedScan:
    """LASER_READING n [ranges] x y theta timestamp; the pose is that of the best particle."""
    count = int(fields[1])
    pose, ranges = _pose(fields[2 + count : 5 + count]), _ranges(fields[2 : 2 + count], count)
    frame = _frame("front", fields[5 + count], ranges, _guessed_angles(count), FLASER_RANGE_MAX_M)
    return LoggedScan(frame, pose, pose)


def _l_line(fields: list[str]) -> LoggedScan:
    """L robot_x y theta laser_x y theta [180 ranges] timestamp; centimetres and radians."""
    count = len(fields) - 8
    ranges = _ranges(fields[7 : 7 + count], count) * np.float32(0.01)
    frame = _frame("front", fields[-1], ranges, _guessed_angles(count), SICK_RANGE_MAX_M)
    return LoggedScan(frame, pose_laser=_pose(fields[4:7], 0.01), pose_robot=_pose(fields[1:4], 0.01))


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


def _odom(fields: list[str], above: LoggedScan | None) -> LoggedOdometry:
    """CARMEN: ODOM x y theta tv rv accel ipc_timestamp host logger_timestamp. GMapping: ODOM x y theta time

    GMapping writes a corrected pose twice, in the scan and in an ODOM line below it, whose time is 0 or
    whatever lay in memory.
    """
    pose = _pose(fields[1:4])
    if len(fields) == 5:
        return LoggedOdometry(_ns(fields[4]), pose)
    if above is not None and pose == above.pose_robot and _restates(fields[7], above):
        return LoggedOdometry(0, pose)
    return LoggedOdometry(_ns(fields[7]), pose, _finite(fields[4]), _finite(fields[5]))


def _restates(text: str, above: LoggedScan) -> bool:
    """Whether a stamp is none of its own: before that of the scan above."""
    stamp_s = Decimal(text)
    return stamp_s.is_finite() and stamp_s < Decimal(above.frame.stamp_ns).scaleb(-9)


def _o_line(fields: list[str]) -> LoggedOdometry:
    """O x y theta timestamp; centimetres and radians."""
    return LoggedOdometry(_ns(fields[4]), _pose(fields[1:4], 0.01))


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
