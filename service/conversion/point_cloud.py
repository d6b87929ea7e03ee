"""sensor_msgs/PointCloud2 to a scan: of a planar laser as it is, of a 3-D laser the points of a height band.

A planar laser's points lie at equal steps of angle, and become the beams they were. Points of a 3-D laser are
turned level, those within the band are kept, and of each angle the nearest one is the beam. Where points have
times and their angles go with them, as those of a laser that rotates do, the scan has its first ray, its
direction and its beam interval by them.
"""

import math
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from drivers.frames import NO_INTENSITY, LaserScan
from service.conversion.config import ConversionConfig
from service.encoding import POINT_CLOUD, read
from service.encoding import ros_messages as ros
from service.encoding.wire import stamp_ns_of

Floats = npt.NDArray[np.float64]

DEFAULT_BAND_M = (0.2, 1.5)  # above the base: walls, and neither the ground nor what hangs
DEFAULT_BAND_OF_UNMOUNTED_M = (-0.3, 0.3)  # above the laser, of whose height nothing is known
MAX_RANGE_M = 100.0
MIN_RANGE_OF_PLANAR_M = 0.01  # the origin itself is what drivers write for no return
PLANAR_M = 0.02  # so much may the z of a planar laser's points differ
BIN_RAD = math.radians(0.25)
MAX_SWEEP_RAD = 6.9  # a little more than a turn
GRID_FIT = 0.2  # of a step, by which the beams of a planar laser may be off their grid
MIN_SWEEP_S, MAX_SWEEP_S = 1e-3, 1.0
MAX_CLOCKS_APART_S = 60.0  # of times that count like the stamp; others have a clock of their own
MAX_OFF_SWEEP_RAD = 0.2  # rms, of the angles of a laser that rotates from a steady turn
STEPS_OF_SWEEP = 40
TIME_FIELDS = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "timeOffset")
_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField


@dataclass(frozen=True, slots=True)
class _Sweep:
    """Steady turn of a laser: a point of angle a was measured at (a - angle_rad) / rate_radps."""

    angle_rad: float
    rate_radps: float


class CloudConverter:
    """Clouds of one device to scans. Whether it is a planar laser is judged by the first cloud with points.

    matrix_base_sensor   (4, 4), takes points of the sensor frame to the base frame; None: it is not known

    Scans are those of a laser that sits where the device sits, level, with its heading.
    """

    def __init__(self, config: ConversionConfig, matrix_base_sensor: Floats | None) -> None:
        matrix = np.eye(4) if matrix_base_sensor is None else matrix_base_sensor
        yaw_rad = math.atan2(matrix[1, 0], matrix[0, 0])
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        self._level = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ matrix[:3, :3]
        self._height_m = float(matrix[2, 3])
        low_m, high_m = DEFAULT_BAND_OF_UNMOUNTED_M if matrix_base_sensor is None else DEFAULT_BAND_M
        self.z_min_m = low_m if config.z_min_m is None else config.z_min_m
        self.z_max_m = high_m if config.z_max_m is None else config.z_max_m
        self._min_range_m = config.min_range_m
        self.is_planar: bool | None = None  # None: no cloud has come

    def scan(self, payload: bytes, sensor: str, log_ns: int) -> LaserScan | None:
        """The scan in a cloud; arrived_ns becomes log_ns. Without a point it has one beam without return.

        None where the cloud has no x and y, or less data than it claims. Raises InputError where the bytes
        are no PointCloud2.
        """
        m = cast(ros.sensor_msgs__msg__PointCloud2, read(POINT_CLOUD, payload))
        points = _points(m)
        if points is None:
            return None
        stamp_ns = stamp_ns_of(m.header.stamp)
        xyz = np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)
        seconds = None if "time" not in points else _seconds(points["time"], stamp_ns)
        kept = np.isfinite(xyz).all(axis=1)
        if seconds is not None:
            kept &= np.isfinite(seconds)
            seconds = seconds[kept]
        xyz = xyz[kept]
        if self.is_planar is None and len(xyz):
            self.is_planar = float(np.ptp(xyz[:, 2])) <= PLANAR_M
        level = xyz @ self._level.T
        range_m = np.hypot(level[:, 0], level[:, 1])
        if self.is_planar:
            kept = range_m >= MIN_RANGE_OF_PLANAR_M
        else:
            height_m = level[:, 2] + self._height_m
            kept = (height_m >= self.z_min_m) & (height_m <= self.z_max_m) & (range_m >= self._min_range_m)
            kept &= range_m > 0.0
        kept &= range_m < MAX_RANGE_M
        if seconds is not None:
            seconds = seconds[kept]
        return self._of_points(level[kept], range_m[kept], seconds, sensor, stamp_ns, log_ns)

    def _of_points(
        self, level: Floats, range_m: Floats, seconds: Floats | None, sensor: str, stamp_ns: int, log_ns: int
    ) -> LaserScan:
        angle_rad = np.arctan2(level[:, 1], level[:, 0])
        sweep = None if seconds is None else _sweep_of(angle_rad, seconds)
        direction, interval_ns, period_ns = 1.0, 0, 0
        if sweep is not None and seconds is not None:
            # along the turn, so that the first ray is the smallest
            direction = math.copysign(1.0, sweep.rate_radps)
            expected = sweep.angle_rad + sweep.rate_radps * seconds
            angle_rad = direction * (expected + _wrapped(angle_rad - expected))
        elif seconds is not None and len(seconds):
            stamp_ns += round(float(np.median(seconds)) * 1e9)
        first_rad, step_rad, count = _beams(angle_rad, bool(self.is_planar))
        beams = np.full(count, np.inf)
        index = np.rint((angle_rad - first_rad) / step_rad).astype(np.intp)
        inside = (index >= 0) & (index < count)
        np.minimum.at(beams, index[inside], range_m[inside])
        if sweep is not None:
            interval_ns = round(step_rad / abs(sweep.rate_radps) * 1e9)
            period_ns = round(math.tau / abs(sweep.rate_radps) * 1e9)
            stamp_ns += round((direction * first_rad - sweep.angle_rad) / sweep.rate_radps * 1e9)
        return LaserScan(
            sensor=sensor,
            stamp_ns=stamp_ns,
            arrived_ns=log_ns,
            beam_interval_ns=interval_ns,
            scan_period_ns=period_ns,
            first_angle_rad=float(_wrapped(direction * first_rad)),
            angle_step_rad=direction * step_rad,
            range_min_m=0.0,
            range_max_m=MAX_RANGE_M,
            range_m=np.where(np.isfinite(beams), beams, np.nan).astype(np.float32),
            intensity=NO_INTENSITY,
        )


def _points(m: ros.sensor_msgs__msg__PointCloud2) -> dict[str, npt.NDArray[Any]] | None:
    """x, y, z and, where there are times, "time", (N,) each, in the types that they come in."""
    order = ">" if m.is_bigendian else "<"
    fields = {field.name: field for field in m.fields if field.datatype in _FORMATS}
    if not {"x", "y"} <= fields.keys() or m.point_step == 0:
        return None
    time = next((name for name in TIME_FIELDS if name in fields), None)
    wanted = [name for name in ("x", "y", "z", time) if name is not None and name in fields]
    row_step = m.row_step if m.height > 1 and m.row_step else m.width * m.point_step
    if m.height * m.width == 0:
        return {name: np.zeros(0) for name in ("x", "y", "z")}
    if row_step < m.width * m.point_step or (m.height - 1) * row_step + m.width * m.point_step > m.data.size:
        return None
    data = np.ascontiguousarray(m.data)
    shape, strides = (m.height, m.width), (row_step, m.point_step)
    found: dict[str, npt.NDArray[Any]] = {}
    for name in wanted:
        kind = np.dtype(order + _FORMATS[fields[name].datatype])
        if fields[name].offset + kind.itemsize > m.point_step:
            return None
        values = np.ndarray(shape, kind, data.data, fields[name].offset, strides).ravel()
        found["time" if name == time else name] = values
    found.setdefault("z", np.zeros(m.height * m.width))
    return found


def _seconds(values: npt.NDArray[Any], stamp_ns: int) -> Floats | None:
    """Times of points after the stamp, s; None where they are in no unit in which they make a sweep."""
    numbers = values.astype(np.float64)
    finite = numbers[np.isfinite(numbers)]
    if not finite.size:
        return None
    first, span = float(finite.min()), float(np.ptp(finite))
    units_s = (1.0, 1e-3, 1e-6, 1e-9) if values.dtype.kind == "f" else (1e-9, 1e-6, 1e-3)
    unit_s = next((unit for unit in units_s if MIN_SWEEP_S <= span * unit <= MAX_SWEEP_S), None)
    if unit_s is None:
        return None
    first_s = first * unit_s
    if abs(first_s) > MAX_CLOCKS_APART_S:  # not counted from the stamp
        first_s -= stamp_ns / 1e9
        if abs(first_s) > MAX_CLOCKS_APART_S:
            first_s = 0.0
    return first_s + (numbers - first) * unit_s


def _sweep_of(angle_rad: Floats, seconds: Floats) -> _Sweep | None:
    """The steady turn in which the points were measured; None where they were not in one."""
    if len(seconds) < STEPS_OF_SWEEP or float(np.ptp(seconds)) < MIN_SWEEP_S:
        return None
    order = np.argsort(seconds, kind="stable")
    angle_rad, seconds = angle_rad[order], seconds[order]
    rows = np.linspace(0, len(order) - 1, STEPS_OF_SWEEP + 1).round().astype(np.intp)
    turned, took = _wrapped(np.diff(angle_rad[rows])), np.diff(seconds[rows])
    if not (took > 0.0).any():
        return None
    rate = float(np.median(turned[took > 0.0] / took[took > 0.0]))
    at = seconds - seconds.mean()
    for _ in range(3):
        off = angle_rad - rate * at
        middle = math.atan2(float(np.sin(off).mean()), float(np.cos(off).mean()))
        off = _wrapped(off - middle)
        more, start = np.polyfit(at, off, 1)
        rate, middle = rate + float(more), middle + float(start)
    off = _wrapped(angle_rad - middle - rate * at)
    if not abs(rate) > 1.0 or float(np.sqrt(np.mean(off**2))) > MAX_OFF_SWEEP_RAD:
        return None
    return _Sweep(middle - rate * float(seconds.mean()), rate)


def _beams(angle_rad: Floats, is_planar: bool) -> tuple[float, float, int]:
    """Angle of the first beam, step, rad, and count: the beams of a planar laser, else bins."""
    if not len(angle_rad):
        return 0.0, BIN_RAD, 1
    if is_planar and (grid := _grid(np.sort(angle_rad))) is not None:
        return grid
    first = math.floor(float(angle_rad.min()) / BIN_RAD)
    count = math.floor(float(angle_rad.max()) / BIN_RAD) - first + 1
    return (first + 0.5) * BIN_RAD, BIN_RAD, min(count, math.floor(MAX_SWEEP_RAD / BIN_RAD))


def _grid(angle_rad: Floats) -> tuple[float, float, int] | None:
    """Equal steps on which all these angles, rising, lie; None where they lie on none."""
    gaps = np.diff(angle_rad)
    gaps = gaps[gaps > 1e-5]
    if len(gaps) < 2:
        return None
    first, step = float(angle_rad[0]), float(np.median(gaps))
    for reach in (20, 200, len(angle_rad)):  # from the first on, so that an error of the step stays below one
        index = np.rint((angle_rad[:reach] - first) / step)
        if index[-1] < 1:
            return None
        step, first = (float(value) for value in np.polyfit(index, angle_rad[:reach], 1))
    index = np.rint((angle_rad - first) / step)
    if np.abs(angle_rad - first - index * step).max() > GRID_FIT * step:
        return None
    count = int(index[-1]) + 1
    return (first, step, count) if step * (count - 1) < MAX_SWEEP_RAD else None


def _wrapped(angle_rad: Any) -> Any:
    """To -pi and pi."""
    return np.mod(angle_rad + math.pi, 2.0 * math.pi) - math.pi
