"""Trajectories in the plane and their TUM files: `stamp tx ty tz qx qy qz qw`, seconds and metres.

Stamps are integer nanoseconds throughout; a float of seconds would lose 100 ns of a Unix time.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from service.errors import InputError
from service.geometry.se2 import SE2, wrap_angle
from service.readable import read_text

NS_PER_S = 1_000_000_000
LARGEST = 1e9  # m; beyond it no double holds a micrometre
MIN_NORM, MAX_NORM = 0.99, 1.01  # of a rounded quaternion


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """pose_map_base at rising stamps."""

    stamp_ns: npt.NDArray[np.int64]  # (N,), strictly rising
    pose: npt.NDArray[np.float64]  # (N, 3) x m, y m, theta rad

    def poses(self) -> Iterator[tuple[int, SE2]]:
        """Stamps, ns, with their poses."""
        return zip(self.stamp_ns.tolist(), (SE2(*pose) for pose in self.pose.tolist()), strict=True)

    def at(self, stamp_ns: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """(M, 3) poses at stamps within it: straight between neighbours, turning by the smaller angle."""
        right = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 1, len(self.stamp_ns) - 1)
        left = right - 1
        span_ns = self.stamp_ns[right] - self.stamp_ns[left]
        share = ((stamp_ns - self.stamp_ns[left]) / span_ns)[:, None]
        step = self.pose[right] - self.pose[left]
        step[:, 2] = wrap_angle(step[:, 2])
        pose = self.pose[left] + share * step
        pose[:, 2] = wrap_angle(pose[:, 2])
        return pose


def seconds_text(stamp_ns: int) -> str:
    """In decimal notation, exactly."""
    return f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S:09d}"


def tum_line(stamp_ns: int, pose: SE2) -> str:
    half_rad = pose.theta_rad / 2.0
    return (
        f"{seconds_text(stamp_ns)} {pose.x_m:.9f} {pose.y_m:.9f} 0 "
        f"0 0 {math.sin(half_rad):.12f} {math.cos(half_rad):.12f}\n"
    )


def write_tum(path: Path, poses: Iterable[tuple[int, SE2]]) -> None:
    """Write (stamp_ns, pose) as they come. Raises OSError."""
    with path.open("w", encoding="ascii") as file:
        file.writelines(tum_line(*pose) for pose in poses)


def read_tum(path: Path) -> Trajectory:
    """Raises InputError with file and line."""
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for where, fields in read_columns(path, 8, "stamp tx ty tz qx qy qz qw"):
        stamp_ns = parse_stamp(fields[0], where)
        x, y, _, qx, qy, qz, qw = parse_numbers(fields[1:], where)
        norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
        if not MIN_NORM <= norm <= MAX_NORM:
            raise InputError(f"{where}: the quaternion's length is {norm:.4f}, expected 1")
        if stamps and stamp_ns <= stamps[-1]:
            raise InputError(f"{where}: the stamp {fields[0]} does not rise above the one before")
        stamps.append(stamp_ns)
        poses.append((x, y, math.atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)))
    if len(stamps) < 2:
        raise InputError(f"{path}: {counted(len(stamps), 'pose')}; a trajectory has at least 2")
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses))


def read_columns(path: Path, count: int, names: str) -> Iterator[tuple[str, list[str]]]:
    """Lines of `count` fields as ("file:line", fields), without comments. Raises InputError."""
    try:
        text = read_text(path)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file: {error.reason} at byte {error.start}") from error
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) != count:
            raise InputError(f"{path}:{number}: {counted(len(fields), 'column')}; expected {count}: {names}")
        yield f"{path}:{number}", fields


def parse_stamp(text: str, where: str) -> int:
    """Seconds in decimal notation -> nanoseconds, exactly. Raises InputError."""
    try:
        stamp = Decimal(text).scaleb(9)
        if not stamp.is_finite() or abs(stamp) >= 2**63:
            raise OverflowError
    except ArithmeticError:
        raise InputError(f"{where}: {text!r} is no time in seconds") from None
    return int(stamp.to_integral_value())


def parse_numbers(fields: list[str], where: str) -> list[float]:
    """Raises InputError."""
    try:
        numbers = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None
    if not all(abs(number) <= LARGEST for number in numbers):
        raise InputError(f"{where}: {' '.join(fields)}: expected finite numbers up to {LARGEST:g}")
    return numbers
