"""Scans of sub-maps; closed ones are kept for the session in a quarter of the memory."""

import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

RANGE_STEP_M = 1e-3  # a tenth of the range noise
BEARING_STEP_RAD = 1e-4  # 1 mm at 10 m


@dataclass(frozen=True, slots=True, eq=False)
class KeyScan:
    """An inserted scan."""

    stamp_ns: int
    xy_base: npt.NDArray[np.float32]  # (N, 2) m, in beam order
    sensor_xy_m: tuple[float, float]  # in the base frame
    angle_step_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class KeptScan:
    """A KeyScan with end points rounded to steps of range and bearing from the sensor.

    Neighbouring beams differ little in range and in bearing step, so differences of ranges and second
    differences of bearings are small; they are deflated to about 2 bytes a beam instead of 8.
    """

    stamp_ns: int
    sensor_xy_m: tuple[float, float]  # in the base frame
    angle_step_rad: float
    packed: bytes

    @classmethod
    def of(cls, scan: "InsertedScan") -> "KeptScan":
        away = scan.xy_base.astype(np.float64) - scan.sensor_xy_m
        ranges = np.rint(np.hypot(*away.T) / RANGE_STEP_M).astype(np.int32)
        bearings = np.rint(np.unwrap(np.arctan2(away[:, 1], away[:, 0])) / BEARING_STEP_RAD).astype(np.int32)
        steps = np.stack((np.diff(ranges, prepend=[0]), np.diff(bearings, 2, prepend=[0, 0])))
        unsigned = ((steps << 1) ^ (steps >> 31)).astype("<u4")  # zigzag: small for either sign
        by_byte = unsigned.view(np.uint8).reshape(-1, 4).T  # the upper ones are nearly all 0
        return cls(scan.stamp_ns, scan.sensor_xy_m, scan.angle_step_rad, zlib.compress(by_byte.tobytes()))

    @property
    def xy_base(self) -> npt.NDArray[np.float32]:
        """(N, 2) m, in beam order, to half a step."""
        by_byte = np.frombuffer(zlib.decompress(self.packed), np.uint8).reshape(4, -1)
        unsigned = np.ascontiguousarray(by_byte.T).view("<u4").astype(np.int64).reshape(2, -1)
        steps = (unsigned >> 1) ^ -(unsigned & 1)
        range_m = RANGE_STEP_M * np.cumsum(steps[0])
        bearing_rad = BEARING_STEP_RAD * np.cumsum(np.cumsum(steps[1]))
        away = np.stack((range_m * np.cos(bearing_rad), range_m * np.sin(bearing_rad)), axis=1)
        return (away + self.sensor_xy_m).astype(np.float32)


InsertedScan = KeyScan | KeptScan
