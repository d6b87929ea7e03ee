"""Frames made of a program's own measurements.

Each is rounded as on the wire and checked as a message of another system is: what comes out is what the
mapper of the service would have had.
"""

import math
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from drivers.frames import NO_INTENSITY, Frame, GnssFix, ImuSample, LaserScan, OdometrySample
from service.encoding import decode_frame, encode_frame
from service.errors import InputError

END_OF_TIME_NS = 2**31 * 10**9  # stamps of ROS messages end there

AnyFrame = TypeVar("AnyFrame", bound=Frame)


def scan(
    range_m: npt.ArrayLike,
    first_angle_rad: float,
    angle_step_rad: float,
    stamp_ns: int,
    *,
    sensor: str = "laser",
    beam_interval_ns: int = 0,
    scan_period_ns: int = 0,
    range_min_m: float = 0.0,
    range_max_m: float = 100.0,
    intensity: npt.ArrayLike | None = None,
) -> LaserScan:
    """One sweep of a planar laser. Beam i looks at first_angle_rad + i * angle_step_rad, counter-clockwise
    from straight ahead in the laser's frame, at stamp_ns + i * beam_interval_ns. Of a laser that is mounted
    upside down both angles are negated.

    range_m           (N,) m; NaN, inf, 0, what a mask of numpy covers, and what is not within range_min_m and
                      range_max_m is no return
    stamp_ns          Unix time of beam 0, ns; any other clock that all frames share will do
    sensor            name of the laser, as in the mountings of the mapper
    beam_interval_ns  from one beam to the next; 0: the sweep is one instant, nothing is deskewed
    scan_period_ns    from one sweep to the next; 0: not known
    intensity         (N,) in units of the device; None: not measured

    Raises InputError for what no laser can have measured.
    """
    ranges = _row(range_m, "range_m", sensor)
    shades = NO_INTENSITY if intensity is None else _row(intensity, "intensity", sensor)
    if shades.size not in (0, ranges.size):
        raise InputError(f"{sensor}: {shades.size} values of intensity for {ranges.size} beams")
    return _as_on_the_wire(
        LaserScan(
            sensor=sensor,
            stamp_ns=stamp_ns,
            arrived_ns=stamp_ns,
            beam_interval_ns=beam_interval_ns,
            scan_period_ns=scan_period_ns,
            first_angle_rad=first_angle_rad,
            angle_step_rad=angle_step_rad,
            range_min_m=range_min_m,
            range_max_m=range_max_m,
            range_m=ranges,
            intensity=shades,
        ),
        "a finite first_angle_rad, an angle_step_rad that is not 0 and spans less than 7 rad over all beams, "
        "and range_min_m < range_max_m",
    )


def odometry(
    x_m: float,
    y_m: float,
    theta_rad: float,
    stamp_ns: int,
    *,
    sensor: str = "base",
    twist: npt.ArrayLike = (0.0, 0.0, 0.0),
    covariance: npt.ArrayLike | None = None,
) -> OdometrySample:
    """Dead reckoning of the wheels: the base in a frame that starts anywhere and never jumps.

    x_m, y_m, theta_rad   m, m, rad; only differences of poses count
    stamp_ns              as of scan
    twist                 m/s forward, m/s left, rad/s in the frame of the base
    covariance            (3, 3) of x, y, theta; m^2, m rad, rad^2. None: not known

    Raises InputError for what is not finite or beyond 1e12.
    """
    forward, left, turn = _numbers(twist, 3, "twist", sensor)
    known = (0.0,) * 9 if covariance is None else _numbers(covariance, 9, "covariance", sensor)
    return _as_on_the_wire(
        OdometrySample(sensor, stamp_ns, stamp_ns, x_m, y_m, theta_rad, (forward, left, turn), known),
        "finite values up to 1e12",
    )


def imu(
    rate_radps: npt.ArrayLike, force_mps2: npt.ArrayLike, stamp_ns: int, *, sensor: str = "imu"
) -> ImuSample:
    """Rates and specific force of an inertial unit in axes x forward, y left, z up: at rest the force is
    (0, 0, 9.81).

    rate_radps, force_mps2   (3,) rad/s and m/s^2
    stamp_ns                 as of scan

    Raises InputError for what is not finite or beyond what sensors measure.
    """
    rx, ry, rz = _numbers(rate_radps, 3, "rate_radps", sensor)
    fx, fy, fz = _numbers(force_mps2, 3, "force_mps2", sensor)
    return _as_on_the_wire(
        ImuSample(sensor, stamp_ns, stamp_ns, (rx, ry, rz), (fx, fy, fz)),
        "finite rates up to 1e3 rad/s and forces up to 1e5 m/s^2",
    )


def fix(
    latitude_deg: float,
    longitude_deg: float,
    stamp_ns: int,
    *,
    altitude_m: float = math.nan,
    covariance: npt.ArrayLike | None = None,
    status: int = 0,
    sensor: str = "gnss",
) -> GnssFix:
    """Where a satellite receiver finds its antenna, WGS 84.

    altitude_m   above the ellipsoid; NaN: not measured
    covariance   (3, 3) of east, north, up, m^2. None: not known
    status       as of sensor_msgs/NavSatStatus: 0 a fix, 1 and 2 augmented, -1 none
    stamp_ns     as of scan

    Raises InputError for what is no place on the earth.
    """
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0):
        raise InputError(
            f"{sensor}: latitude {latitude_deg}, longitude {longitude_deg}; expected up to 90 and 180 deg"
        )
    known = (0.0,) * 9 if covariance is None else _numbers(covariance, 9, "covariance", sensor)
    place = (latitude_deg, longitude_deg, altitude_m)
    return _as_on_the_wire(
        GnssFix(sensor, stamp_ns, stamp_ns, status, *place, known), "a finite covariance and altitude"
    )


def _row(values: npt.ArrayLike, name: str, sensor: str) -> npt.NDArray[np.float32]:
    try:
        # copied: a frame makes its arrays read-only
        row = np.ma.filled(np.ma.array(values, np.float32, copy=True), np.nan)
    except (TypeError, ValueError) as error:
        raise InputError(f"{sensor}: {name} are no numbers: {error}") from error
    if row.ndim != 1:
        raise InputError(f"{sensor}: {name} of shape {row.shape}; expected one row, (N,)")
    return row


def _numbers(values: npt.ArrayLike, count: int, name: str, sensor: str) -> tuple[float, ...]:
    numbers = np.asarray(values, np.float64).ravel()
    if numbers.size != count:
        raise InputError(f"{sensor}: {name} has {numbers.size} values; expected {count}")
    return tuple(numbers.tolist())


def _as_on_the_wire(frame: AnyFrame, expected: str) -> AnyFrame:
    is_whole = isinstance(frame.stamp_ns, int | np.integer)
    if not is_whole or not 0 <= frame.stamp_ns < END_OF_TIME_NS:
        raise InputError(
            f"{frame.sensor}: stamp_ns is {frame.stamp_ns!r}; expected whole ns from 0 to {END_OF_TIME_NS}"
        )
    message = encode_frame(frame)
    decoded = decode_frame(message.type, message.payload, frame.sensor, message.log_ns)
    if not isinstance(decoded, type(frame)):
        raise InputError(f"{frame.sensor} at {frame.stamp_ns} ns: no measurement; expected {expected}")
    return decoded
