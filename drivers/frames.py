"""Frames: what a driver hands on. SI units, host time, arrays read-only.

Axes are those of ROS REP 103: x forward, y left, z up, angles counter-clockwise.
`stamp_ns` is when it was measured, `arrived_ns` when its last byte was read; both on one clock, which is
the host's monotonic clock where a driver made the frame and Unix time where a recording did.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One sweep of a planar laser; beam i looks at first_angle_rad + i * angle_step_rad at
    stamp_ns + i * beam_interval_ns.

    "No return" is NaN in range_m, so it can never be mistaken for a wall at zero metres. Where the device
    names a cause, the payload of the NaN (IEEE 754-2008, 6.2) is its number, see `no_distance`.
    """

    sensor: str  # name from the config, e.g. "front"
    stamp_ns: int  # moment of beam 0
    arrived_ns: int
    beam_interval_ns: int  # from one beam to the next; deskew needs it. 0: the sweep is one instant
    scan_period_ns: int  # from one sweep to the next
    first_angle_rad: float  # sensor frame, counter-clockwise, 0 = straight ahead
    angle_step_rad: float  # negative where the device sweeps clockwise
    range_min_m: float
    range_max_m: float
    range_m: npt.NDArray[np.float32]  # (N,), read-only
    intensity: npt.NDArray[np.float32]  # (N,) in device units, or (0,) where not configured; read-only

    def __post_init__(self) -> None:
        self.range_m.setflags(write=False)
        self.intensity.setflags(write=False)


# Why a beam has no distance, by the devices' protocols; 0: no return, or the device gives no reason.
CAUSES = (
    *("no_return", "dazzled", "implausible", "filtered", "reserved_code", "too_near", "interference"),
    *("near_limit", "too_weak", "unlike_neighbours", "two_waves", "error_twice", "too_bright"),
    *("not_measurable", "other_error", "dirt", "rain", "ground", "transparent"),
)
_QUIET_NAN = 0x7FC00000


def no_distance(*causes: str) -> npt.NDArray[np.float32]:
    """(N,) NaN, each with its cause; one that is not among CAUSES counts as "no_return"."""
    numbers = [CAUSES.index(cause) if cause in CAUSES else 0 for cause in causes]
    return np.array([_QUIET_NAN | number for number in numbers], np.uint32).view(np.float32)


def causes_of(range_m: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """(N,) indices of CAUSES; 0 also where there is a distance, or a NaN that `no_distance` did not make."""
    number = np.ascontiguousarray(range_m).view(np.uint32) ^ np.uint32(_QUIET_NAN)
    return np.where(number < len(CAUSES), number, 0).astype(np.uint8)


NO_INTENSITY: npt.NDArray[np.float32] = np.empty(0, dtype=np.float32)
NO_INTENSITY.setflags(write=False)


@dataclass(frozen=True, slots=True)
class ImuSample:
    """Rates and specific force in the sensor frame, x forward, y left, z up."""

    sensor: str
    stamp_ns: int
    arrived_ns: int
    rate_radps: tuple[float, float, float]
    force_mps2: tuple[float, float, float]
    orientation_wxyz: tuple[float, float, float, float] | None = None  # world from sensor; None: not measured


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """Dead reckoning of the wheels: pose of the base in a frame that starts where the driver started.

    Only differences of poses are meaningful; covariance is that of the pose and grows with the distance.
    """

    sensor: str
    stamp_ns: int
    arrived_ns: int
    x_m: float
    y_m: float
    theta_rad: float
    twist_mps_radps: tuple[float, float, float]  # base frame: forward, left, turn
    covariance: tuple[float, ...]  # 9 values, row-major (x, y, theta); m^2, m rad, rad^2. All 0: unknown


@dataclass(frozen=True, slots=True)
class GnssFix:
    """Position of a GNSS receiver's antenna, WGS 84. Without a fix its three coordinates are NaN."""

    sensor: str
    stamp_ns: int
    arrived_ns: int
    status: int  # as sensor_msgs/NavSatStatus: -1 no fix, 0 fix, 1 augmented by satellites, 2 from the ground
    latitude_deg: float
    longitude_deg: float
    altitude_m: float  # above the ellipsoid; NaN: the receiver gives none
    covariance: tuple[float, ...]  # 9 values, row-major (east, north, up), m^2. All 0: unknown


Frame = LaserScan | ImuSample | OdometrySample | GnssFix
