"""Frames <-> their ROS messages. Decoding looks at nothing but payload, sensor name and log time."""

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar, cast, get_args

import numpy as np

from drivers.counted import counted
from drivers.frames import NO_INTENSITY, Frame, GnssFix, ImuSample, LaserScan, OdometrySample, causes_of
from drivers.link import ChunkKind, RawChunk
from service.encoding import quick, wire
from service.encoding import ros_messages as ros
from service.encoding.wire import Message
from service.errors import InputError
from service.geometry.se2 import SE2

SERVICE_GPS = 1  # sensor_msgs/NavSatStatus
COVARIANCE_UNKNOWN, COVARIANCE_DIAGONAL, COVARIANCE_KNOWN = 0, 2, 3  # sensor_msgs/NavSatFix
_FRAME_ID_AT = 12  # its length, after 4 bytes of CDR and the stamp
# Values beyond these are damage and not measurements: a gyroscope reads at most 70 rad/s, an accelerometer
# 4000 m/s^2; metres, m/s and the variances of odometry stay far below.
MAX_RATE_RADPS, MAX_FORCE_MPS2, MAX_ODOMETRY = 1e3, 1e5, 1e12
MAX_SPAN_OFF_RAD, MAX_BEAMS_OFF = math.radians(2.0), 3  # of the last beam from angle_max
UNSET_RANGE_MAX_M = 100.0  # for a foreign scan whose range_max is 0, inf or NaN

NO_ROTATION, NO_COVARIANCE = "no rotation", "no covariance"

_UNKNOWN_9 = (0.0,) * 9
_NOT_MEASURED_9 = (-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # sensor_msgs/Imu: element 0 is -1
AnyFrame = TypeVar("AnyFrame", bound=Frame | None)

_NAN = np.float32(np.nan)
_NO_RETURN = np.float32(np.inf)  # REP 117: beyond the range of the sensor
_SMALLEST_RANGE_M = float(np.finfo(np.float32).tiny)
KINDS: tuple[ChunkKind, ...] = get_args(ChunkKind)


def encode_frame(frame: Frame, utc_offset_ns: int = 0, log_ns: int | None = None) -> Message:
    """A frame as its ROS message; utc_offset_ns is added to the frame's times.

    log_ns is its log time (see LogClock); left out, it is the time of arrival. No return becomes +inf
    (REP 117).
    """
    stamp_ns = frame.stamp_ns + utc_offset_ns
    if log_ns is None:
        log_ns = frame.arrived_ns + utc_offset_ns
    match frame:
        case LaserScan():
            kind, type_name, content = "scan", wire.LASER_SCAN, _scan_ros(frame, stamp_ns)
        case ImuSample():
            payload = quick.imu(stamp_ns, frame.sensor, _imu_values(frame))
            return Message(f"{frame.sensor}/imu", wire.IMU, stamp_ns, log_ns, payload)
        case OdometrySample():
            payload = _odometry_payload(frame, stamp_ns)
            return Message(f"{frame.sensor}/odom", wire.ODOMETRY, stamp_ns, log_ns, payload)
        case GnssFix():
            kind, type_name, content = "fix", wire.NAV_SAT_FIX, _fix_ros(frame, stamp_ns)
    return wire.to_message(f"{frame.sensor}/{kind}", type_name, stamp_ns, log_ns, content)


def decode_frame(
    message_type: str, payload: bytes, sensor: str, log_ns: int, upside_down: bool = False
) -> Frame | None:
    """The frame in a LaserScan, Imu, Odometry or NavSatFix message of any origin; arrived_ns becomes log_ns.

    Of a sensor that is mounted upside down, turned about its forward axis, scans and rates are turned back.

    None for another type and for content that no mapper can use: a scan without beams or with an impossible
    angle step, an Imu without a gyroscope, values that are not finite or beyond what a sensor can measure. A
    NavSatFix without a fix is content, and so is one without an altitude (NaN). So is an Odometry whose
    covariance is none; that counts as unknown.
    Raises InputError on bytes that are not a message of that type.
    """
    frame: Frame | None
    if message_type == wire.IMU and (imu := quick.read_imu(payload)) is not None:
        frame = _imu_sample(sensor, log_ns, *imu)
    elif message_type == wire.ODOMETRY and (odometry := quick.read_odometry(payload)) is not None:
        frame = _odometry_sample(sensor, log_ns, *odometry)
    else:
        decode = _FRAME_DECODERS.get(message_type)
        frame = None if decode is None else decode(wire.read(message_type, payload), sensor, log_ns)
    return turned_over(frame) if upside_down else frame


def scan_fault(message_type: str, payload: bytes) -> str:
    """Why no mapper can use a LaserScan, with the figures; "" where one can, and for another type."""
    if message_type != wire.LASER_SCAN:
        return ""
    try:
        return _fault_of_fields(cast(ros.sensor_msgs__msg__LaserScan, wire.read(message_type, payload)))
    except InputError as error:
        return str(error)


def span_fault(payload: bytes) -> str:
    """Where the last beam of a LaserScan or MultiEchoLaserScan lies elsewhere than its angle_max, by more
    than rounding or another count of the ends; "" where it does not, or angle_max is not set.

    Only for payloads that decode_frame has read.
    """
    order = "<" if payload[1] & 1 else ">"
    (size,) = struct.unpack_from(f"{order}I", payload, _FRAME_ID_AT)
    numbers = struct.unpack_from(f"{order}7fI", payload, (_FRAME_ID_AT + 4 + size + 3) & ~3)
    first, last, step, beams = *numbers[:3], numbers[7]
    end = first + step * (beams - 1)
    if last in (0.0, first) or not abs(last - end) > max(MAX_SPAN_OFF_RAD, MAX_BEAMS_OFF * abs(step)):
        return ""
    step_deg, first_deg, end_deg, last_deg = (
        f"{round(math.degrees(angle), 3) + 0.0:g}" for angle in (step, first, end, last)
    )
    return (
        f"{counted(beams, 'beam')} at steps of {step_deg} deg from {first_deg} deg end at {end_deg} deg, "
        f"angle_max is {last_deg} deg"
    )


def odometry_fault(payload: bytes) -> str:
    """NO_ROTATION where the orientation in a nav_msgs/Odometry is a quaternion of 0, NO_COVARIANCE where the
    covariance of its pose is none; "" for all else, and for bytes that are no such message.
    """
    try:
        odometry = quick.read_odometry(payload) or _odometry_values(wire.read(wire.ODOMETRY, payload))
    except InputError:
        return ""
    _, values = odometry
    if not any(values[3:7]):
        return NO_ROTATION
    return "" if _is_covariance(_planar_covariance(values)) else NO_COVARIANCE


def turned_over(frame: AnyFrame) -> AnyFrame:
    """Of a sensor that is mounted upside down, turned about its forward axis: as if it were not."""
    if isinstance(frame, LaserScan):
        return replace(frame, first_angle_rad=-frame.first_angle_rad, angle_step_rad=-frame.angle_step_rad)
    if isinstance(frame, ImuSample):
        (rx, ry, rz), (fx, fy, fz) = frame.rate_radps, frame.force_mps2
        return replace(frame, rate_radps=(rx, -ry, -rz), force_mps2=(fx, -fy, -fz), orientation_wxyz=None)
    return frame


def frame_id(payload: bytes) -> str:
    """header.frame_id of a message that begins with a header; the rest is not read. Raises InputError."""
    try:
        order = "<" if payload[1] & 1 else ">"
        (size,) = struct.unpack_from(f"{order}I", payload, _FRAME_ID_AT)
        (text,) = struct.unpack_from(f"{size}s", payload, _FRAME_ID_AT + 4)
        return str(text, "utf-8").rstrip("\0").lstrip("/")  # tf 1 wrote "/laser"
    except (IndexError, struct.error, UnicodeDecodeError) as error:
        raise InputError(
            f"{counted(len(payload), 'byte')} cannot begin with a std_msgs/Header: {error}"
        ) from error


def _duration_ns(seconds: float) -> int:
    """0 where a foreign message leaves the field unset or senseless."""
    return round(seconds * 1e9) if 0.0 < seconds < 1e6 else 0


def _scan_ros(scan: LaserScan, stamp_ns: int) -> object:
    return ros.sensor_msgs__msg__LaserScan(
        header=wire.header_ros(stamp_ns, scan.sensor),
        angle_min=scan.first_angle_rad,
        angle_max=scan.first_angle_rad + scan.angle_step_rad * (scan.range_m.size - 1),
        angle_increment=scan.angle_step_rad,
        time_increment=scan.beam_interval_ns * 1e-9,
        scan_time=scan.scan_period_ns * 1e-9,
        range_min=scan.range_min_m,
        range_max=scan.range_max_m,
        ranges=np.where(np.isnan(scan.range_m) & (causes_of(scan.range_m) == 0), _NO_RETURN, scan.range_m),
        intensities=scan.intensity,
    )


def _scan_frame(content: object, sensor: str, log_ns: int) -> LaserScan | None:
    return scan_of_fields(cast(ros.sensor_msgs__msg__LaserScan, content), sensor, log_ns)


def scan_of_fields(m: ros.sensor_msgs__msg__LaserScan, sensor: str, log_ns: int) -> LaserScan | None:
    """The frame in the fields of a LaserScan, see decode_frame."""
    if _fault_of_fields(m):
        return None
    range_min_m, range_max_m = _range_limits(m)
    stamp_ns, first_rad, step_rad = wire.stamp_ns_of(m.header.stamp), m.angle_min, m.angle_increment
    ranges, intensities, interval_s = m.ranges, m.intensities, m.time_increment
    if interval_s < 0.0 and (sweep_ns := _duration_ns(-interval_s * (ranges.size - 1))):
        # the last beam was measured first, as drivers of inverted lasers have it
        ranges, intensities, interval_s = ranges[::-1], intensities[::-1], -interval_s
        first_rad, step_rad = first_rad + step_rad * (ranges.size - 1), -step_rad
        stamp_ns -= sweep_ns
    # range_max itself is what many drivers send for "nothing seen", so it counts as no return.
    valid = (ranges >= max(range_min_m, _SMALLEST_RANGE_M)) & (ranges < range_max_m)
    return LaserScan(
        sensor=sensor,
        stamp_ns=stamp_ns,
        arrived_ns=log_ns,
        beam_interval_ns=_duration_ns(interval_s),
        scan_period_ns=_duration_ns(m.scan_time),
        first_angle_rad=first_rad,
        angle_step_rad=step_rad,
        range_min_m=range_min_m,
        range_max_m=range_max_m,
        range_m=np.where(valid | np.isnan(ranges), ranges, _NAN).astype(np.float32, copy=False),
        # copied: an array that looks into the payload may be unaligned, which is another type to numba
        intensity=intensities.astype(np.float32) if intensities.size == ranges.size else NO_INTENSITY,
    )


def _fault_of_fields(m: ros.sensor_msgs__msg__LaserScan) -> str:
    count, step = m.ranges.size, m.angle_increment
    span = abs(step) * max(count - 1, 1)
    if count == 0:
        return "it has no ranges"
    if not math.isfinite(m.angle_min):
        return f"angle_min is {m.angle_min}"
    if not 0.0 < span < 7.0:
        return (
            f"{counted(count, 'beam')} with angle_increment {step:.4g} rad span {math.degrees(span):.4g} "
            "deg, expected more than 0 and at most 360 deg; is angle_increment in rad?"
        )
    range_min_m, range_max_m = _range_limits(m)
    if range_min_m >= range_max_m:  # one of them is wrong, and no one knows which
        return f"range_min {range_min_m:.4g} m is not below range_max {range_max_m:.4g} m"
    return ""


def _range_limits(m: ros.sensor_msgs__msg__LaserScan) -> tuple[float, float]:
    return (
        m.range_min if m.range_min >= 0.0 else 0.0,
        m.range_max if 0.0 < m.range_max < math.inf else UNSET_RANGE_MAX_M,
    )


def _imu_values(sample: ImuSample) -> tuple[float, ...]:
    """The numbers of a sensor_msgs/Imu in their order."""
    w, x, y, z = sample.orientation_wxyz if sample.orientation_wxyz is not None else (1.0, 0.0, 0.0, 0.0)
    covariance = _NOT_MEASURED_9 if sample.orientation_wxyz is None else _UNKNOWN_9
    return (x, y, z, w, *covariance, *sample.rate_radps, *_UNKNOWN_9, *sample.force_mps2, *_UNKNOWN_9)


def _imu_frame(content: object, sensor: str, log_ns: int) -> ImuSample | None:
    m = cast(ros.sensor_msgs__msg__Imu, content)
    q, rate, force = m.orientation, m.angular_velocity, m.linear_acceleration
    values = (
        *(q.x, q.y, q.z, q.w, *m.orientation_covariance.tolist()),
        *(rate.x, rate.y, rate.z, *m.angular_velocity_covariance.tolist()),
        *(force.x, force.y, force.z, *m.linear_acceleration_covariance.tolist()),
    )
    return _imu_sample(sensor, log_ns, wire.stamp_ns_of(m.header.stamp), values)


def _imu_sample(sensor: str, log_ns: int, stamp_ns: int, values: Sequence[float]) -> ImuSample | None:
    """values: as _imu_values has them."""
    x, y, z, w, is_oriented = values[:5]
    rx, ry, rz, is_turning = values[13:17]
    fx, fy, fz = values[25:28]
    if is_turning == -1.0 or not wire.all_finite(rx, ry, rz, fx, fy, fz):
        return None
    if max(abs(rx), abs(ry), abs(rz)) > MAX_RATE_RADPS or max(abs(fx), abs(fy), abs(fz)) > MAX_FORCE_MPS2:
        return None
    orientation = (w, x, y, z)
    measured = is_oriented != -1.0 and wire.all_finite(*orientation) and any(orientation)
    return ImuSample(
        sensor=sensor,
        stamp_ns=stamp_ns,
        arrived_ns=log_ns,
        rate_radps=(rx, ry, rz),
        force_mps2=(fx, fy, fz),
        orientation_wxyz=orientation if measured else None,
    )


def _odometry_payload(sample: OdometrySample, stamp_ns: int) -> bytes:
    pose = SE2(sample.x_m, sample.y_m, sample.theta_rad)
    frame = f"{sample.sensor}_{wire.ODOM_FRAME}"  # the wheels' own; `odom` is the mapper's
    return wire.odometry_payload(stamp_ns, frame, pose, sample.covariance, sample.twist_mps_radps)


def _odometry_frame(content: object, sensor: str, log_ns: int) -> OdometrySample | None:
    return _odometry_sample(sensor, log_ns, *_odometry_values(content))


def _odometry_values(content: object) -> tuple[int, tuple[float, ...]]:
    """As quick.read_odometry has them, but without the covariance of the twist."""
    m = cast(ros.nav_msgs__msg__Odometry, content)
    p, q, linear, angular = (
        m.pose.pose.position,
        m.pose.pose.orientation,
        m.twist.twist.linear,
        m.twist.twist.angular,
    )
    values = (
        *(p.x, p.y, p.z, q.x, q.y, q.z, q.w, *m.pose.covariance.tolist()),
        *(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z),
    )
    return wire.stamp_ns_of(m.header.stamp), values


def _odometry_sample(
    sensor: str, log_ns: int, stamp_ns: int, values: Sequence[float]
) -> OdometrySample | None:
    """values: the numbers of a nav_msgs/Odometry in their order; the covariance of the twist is not read."""
    x_m, y_m = values[:2]
    theta_rad = wire.yaw(ros.geometry_msgs__msg__Quaternion(*values[3:7]))
    twist = (values[43], values[44], values[48])
    if not wire.all_finite(x_m, y_m, theta_rad, *twist):
        return None
    if max(map(abs, (x_m, y_m, *twist))) > MAX_ODOMETRY:
        return None
    covariance = _planar_covariance(values)
    return OdometrySample(
        sensor=sensor,
        stamp_ns=stamp_ns,
        arrived_ns=log_ns,
        x_m=x_m,
        y_m=y_m,
        theta_rad=theta_rad,
        twist_mps_radps=twist,
        covariance=covariance if _is_covariance(covariance) else _UNKNOWN_9,
    )


def _planar_covariance(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(values[7 + cell] for cell in wire.PLANAR_CELLS_OF_36)


def _is_covariance(values: Sequence[float]) -> bool:
    return wire.all_finite(*values) and max(map(abs, values)) <= MAX_ODOMETRY


def _fix_ros(fix: GnssFix, stamp_ns: int) -> object:
    covariance = np.array(fix.covariance)
    return ros.sensor_msgs__msg__NavSatFix(
        header=wire.header_ros(stamp_ns, fix.sensor),
        status=ros.sensor_msgs__msg__NavSatStatus(fix.status, SERVICE_GPS),
        latitude=fix.latitude_deg,
        longitude=fix.longitude_deg,
        altitude=fix.altitude_m,
        position_covariance=covariance,
        position_covariance_type=_covariance_type(covariance),
    )


def _covariance_type(covariance: wire.FloatArray) -> int:
    if not covariance.any():
        return COVARIANCE_UNKNOWN
    diagonal = np.diag(covariance.reshape(3, 3))
    return (
        COVARIANCE_DIAGONAL
        if np.count_nonzero(covariance) == np.count_nonzero(diagonal)
        else COVARIANCE_KNOWN
    )


def _fix_frame(content: object, sensor: str, log_ns: int) -> GnssFix | None:
    m = cast(ros.sensor_msgs__msg__NavSatFix, content)
    place = (m.latitude, m.longitude, m.altitude)
    known = m.position_covariance_type != COVARIANCE_UNKNOWN
    covariance = tuple(m.position_covariance.tolist()) if known else (0.0,) * 9
    if m.status.status < 0:
        place, covariance = (math.nan, math.nan, math.nan), (0.0,) * 9
    elif not wire.all_finite(*place[:2], *covariance) or math.isinf(place[2]):
        return None
    return GnssFix(
        sensor=sensor,
        stamp_ns=wire.stamp_ns_of(m.header.stamp),
        arrived_ns=log_ns,
        status=m.status.status,
        latitude_deg=place[0],
        longitude_deg=place[1],
        altitude_m=place[2],
        covariance=covariance,
    )


_FRAME_DECODERS: dict[str, Callable[[object, str, int], Frame | None]] = {
    wire.LASER_SCAN: _scan_frame,
    wire.IMU: _imu_frame,
    wire.ODOMETRY: _odometry_frame,
    wire.NAV_SAT_FIX: _fix_frame,
}


def encode_raw(sensor: str, chunk: RawChunk, utc_offset_ns: int) -> Message:
    """The chunk's bytes; what kind it is stands as label of the array's one dimension.

    Stamp and log time are the chunk's own to the nanosecond: drivers reckon with it.
    """
    at_ns = chunk.at_ns + utc_offset_ns
    size = len(chunk.data)
    layout = ros.std_msgs__msg__MultiArrayLayout(
        [ros.std_msgs__msg__MultiArrayDimension(chunk.kind, size, size)], data_offset=0
    )
    content = ros.std_msgs__msg__UInt8MultiArray(layout, np.frombuffer(chunk.data, dtype=np.uint8))
    return wire.to_message(f"{sensor}/raw", wire.BYTES, at_ns, at_ns, content)


def decode_raw(payload: bytes, log_ns: int, utc_offset_ns: int) -> RawChunk:
    """Raises InputError."""
    m = cast(ros.std_msgs__msg__UInt8MultiArray, wire.read(wire.BYTES, payload))
    label = m.layout.dim[0].label if m.layout.dim else ""
    kind = next((kind for kind in KINDS if kind == label), None)
    if kind is None:
        raise InputError(f"raw bytes labelled {label!r}; expected {', '.join(KINDS)}")
    return RawChunk(log_ns - utc_offset_ns, kind, m.data.tobytes())
