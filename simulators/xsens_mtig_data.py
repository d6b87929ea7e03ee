"""What a fake MTi-G puts into its data messages: one sample of the truth, coded as it is configured."""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from drivers.xsens_mtig.health import FILTER_VALID, GNSS_FIX, SELFTEST_OK
from drivers.xsens_mtig.mtdata import EULER, MATRIX, QUATERNION, LegacyCodec, LegacyData, Mode, RawGps
from drivers.xsens_mtig.mtdata2 import (
    FRAME_MASK,
    KIND_MASK,
    GnssPvt,
    Kind,
    LocalFrame,
    Utc,
    Value,
    join,
    write_item,
)
from drivers.xsens_mtig.orientation import quaternion_of_matrix
from simulators.inertial import Place
from simulators.trajectory import Floats

UtcBeforeFix = Literal["runs", "absent", "no_date", "stands"]
WEEK_MS = 604_800_000
GPS_EPOCH_S, LEAP_S = 315_964_800, 18
UTC_VALID, UTC_UNKNOWN = 0x37, 0x00
GNSS_OFF_NS = -231_000  # the receiver's solutions lie this much beside the full 250 ms
FIELD_ENU = (0.0, 0.28, -0.96)  # of the earth in northern Europe, 1 = its strength
WGS84_A_M, WGS84_E2 = 6_378_137.0, 6.694_379_990_14e-3

# Columns: east, north, up -> the local frame. From the matrices RotLocal of the MTi User Manual MT0605P.
LOCAL_FROM_ENU = {
    LocalFrame.ENU: np.eye(3),
    LocalFrame.NED: np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    LocalFrame.NWU: np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
}


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """State of the device at one moment."""

    ticks: int  # SampleTimeFine
    packet: int
    utc_ns: int
    utc_known: bool
    utc_before_fix: UtcBeforeFix
    rate_radps: Floats
    force_mps2: Floats
    enu_from_sensor: Floats  # (3, 3)
    filter_valid: bool
    clipped: int  # bits 8 to 16 of the status word
    period_s: float
    place: Place | None  # the receiver's newest solution
    estimate: Place | None  # of the filter, at this very moment


def euler_deg(matrix: Floats) -> tuple[float, float, float]:
    """Roll, pitch, yaw of the aerospace order."""
    return (
        math.degrees(math.atan2(matrix[2, 1], matrix[2, 2])),
        math.degrees(-math.asin(max(-1.0, min(1.0, matrix[2, 0])))),
        math.degrees(math.atan2(matrix[1, 0], matrix[0, 0])),
    )


def calendar(utc_ns: int, known: int) -> Utc:
    seconds, nanosecond = divmod(utc_ns, 1_000_000_000)
    t = datetime.fromtimestamp(seconds, UTC)
    return Utc(nanosecond, t.year, t.month, t.day, t.hour, t.minute, t.second, known)


def status_word(sample: Sample) -> int:
    word = SELFTEST_OK | sample.clipped
    word |= FILTER_VALID if sample.filter_valid else 0
    word |= 0x80000 if sample.clipped else 0
    return word | (GNSS_FIX | 0x180_0000 if sample.place is not None else 0)


def _local(identifier: int) -> Floats:
    return LOCAL_FROM_ENU[LocalFrame(identifier & FRAME_MASK)]


def _orientation(identifier: int, sample: Sample) -> Floats:
    rotation: Floats = _local(identifier) @ sample.enu_from_sensor
    return rotation


def _delta_q(sample: Sample) -> tuple[float, ...]:
    half = sample.rate_radps * (sample.period_s / 2.0)
    size = float(np.linalg.norm(half))
    return (math.cos(size), *(half * (math.sin(size) / size if size else 1.0)).tolist())


def _velocity(identifier: int, sample: Sample) -> tuple[float, ...]:
    enu = np.zeros(3) if sample.estimate is None else np.array(sample.estimate.velocity_enu_mps)
    return tuple((_local(identifier) @ enu).tolist())


def _free(identifier: int, sample: Sample) -> tuple[float, ...]:
    enu = sample.enu_from_sensor @ sample.force_mps2 - np.array([0.0, 0.0, 9.81])
    return tuple((_local(identifier) @ enu).tolist())


def _ecef(sample: Sample) -> tuple[float, ...]:
    p = sample.estimate
    assert p is not None
    latitude, longitude = math.radians(p.latitude_deg), math.radians(p.longitude_deg)
    n = WGS84_A_M / math.sqrt(1.0 - WGS84_E2 * math.sin(latitude) ** 2)
    ring = (n + p.height_m) * math.cos(latitude)
    up = (n * (1.0 - WGS84_E2) + p.height_m) * math.sin(latitude)
    return ring * math.cos(longitude), ring * math.sin(longitude), up


def _magnetic(sample: Sample) -> tuple[float, ...]:
    return tuple((sample.enu_from_sensor.T @ np.array(FIELD_ENU)).tolist())


STANDING_UTC = Utc(0, 2000, 1, 1, 0, 0, 0, UTC_UNKNOWN)


def _utc(sample: Sample) -> Utc:
    if sample.utc_known:
        return calendar(sample.utc_ns, UTC_VALID)
    if sample.utc_before_fix == "runs":
        return calendar(sample.utc_ns, UTC_UNKNOWN)
    return STANDING_UTC if sample.utc_before_fix == "stands" else Utc(0, 0, 0, 0, 0, 0, 0, 0)


NEEDS_FILTER = frozenset((Kind.QUATERNION, Kind.MATRIX, Kind.EULER, Kind.FREE_ACCELERATION))
NEEDS_PLACE = frozenset((Kind.ALTITUDE, Kind.ECEF, Kind.LAT_LON, Kind.VELOCITY))
_VALUES: dict[int, Callable[[int, Sample], Value]] = {
    Kind.TEMPERATURE: lambda i, s: (31.5,),
    Kind.UTC: lambda i, s: _utc(s),
    Kind.PACKET_COUNTER: lambda i, s: s.packet,
    Kind.SAMPLE_TIME_FINE: lambda i, s: s.ticks,
    Kind.SAMPLE_TIME_COARSE: lambda i, s: s.ticks // 10_000,
    Kind.QUATERNION: lambda i, s: quaternion_of_matrix(_orientation(i, s).ravel().tolist()),
    Kind.MATRIX: lambda i, s: tuple(_orientation(i, s).ravel().tolist()),
    Kind.EULER: lambda i, s: euler_deg(_orientation(i, s)),
    Kind.PRESSURE: lambda i, s: 101_325,
    Kind.DELTA_V: lambda i, s: tuple((s.force_mps2 * s.period_s).tolist()),
    Kind.ACCELERATION: lambda i, s: tuple(s.force_mps2.tolist()),
    Kind.FREE_ACCELERATION: _free,
    Kind.ACCELERATION_HR: lambda i, s: tuple(s.force_mps2.tolist()),
    Kind.ALTITUDE: lambda i, s: (s.estimate.height_m if s.estimate else 0.0,),
    Kind.ECEF: lambda i, s: _ecef(s),
    Kind.LAT_LON: lambda i, s: (
        (s.estimate.latitude_deg, s.estimate.longitude_deg) if s.estimate else (0.0, 0.0)
    ),
    Kind.RATE: lambda i, s: tuple(s.rate_radps.tolist()),
    Kind.DELTA_Q: lambda i, s: _delta_q(s),
    Kind.RATE_HR: lambda i, s: tuple(s.rate_radps.tolist()),
    Kind.MAGNETIC_FIELD: lambda i, s: _magnetic(s),
    Kind.VELOCITY: _velocity,
    Kind.STATUS_BYTE: lambda i, s: status_word(s) & 0xFF,
    Kind.STATUS_WORD: lambda i, s: status_word(s),
    Kind.DEVICE_ID: lambda i, s: struct.pack(">I", 0x0770_0DB1),
}


def can_send(identifier: int) -> bool:
    return identifier & KIND_MASK in _VALUES or identifier & KIND_MASK == Kind.GNSS_PVT


def inertial_message(identifiers: list[int], sample: Sample) -> bytes:
    """Data of an MTData2 message. Values that the filter or the receiver do not have yet are left out."""
    items = []
    for identifier in identifiers:
        kind = identifier & KIND_MASK
        if (kind in NEEDS_FILTER and not sample.filter_valid) or (
            kind in NEEDS_PLACE and sample.estimate is None
        ):
            continue
        if kind == Kind.UTC and not sample.utc_known and sample.utc_before_fix == "absent":
            continue
        items.append((identifier, write_item(identifier, _VALUES[kind](identifier, sample))))
    return join(items)


def gnss_message(identifiers: list[int], sample: Sample) -> bytes:
    """As of real ones: the solution first, then the times, no status."""
    items = [(int(Kind.GNSS_PVT), write_item(Kind.GNSS_PVT, solution(sample)))]
    for kind in (Kind.UTC, Kind.SAMPLE_TIME_FINE, Kind.PACKET_COUNTER):
        if kind in identifiers:
            items.append((int(kind), write_item(kind, _VALUES[kind](kind, sample))))
    return join(items)


def itow_ms(utc_ns: int) -> int:
    """GPS time of week."""
    return (utc_ns // 1_000_000 - GPS_EPOCH_S * 1000 + LEAP_S * 1000) % WEEK_MS


def solution(sample: Sample) -> GnssPvt:
    """The receiver's solution at this moment, a full 250 ms of UTC; without satellites as of a real one."""
    p = sample.place
    if p is None:
        blank = GnssPvt._make([0] * len(GnssPvt._fields))
        dilution = {name: 9999 for name in GnssPvt._fields if name.endswith("dop_1e2")}
        return blank._replace(
            itow_ms=itow_ms(sample.utc_ns),
            year=1980,
            month=1,
            day=6,
            horizontal_accuracy_mm=0xFFFF_FFFF,
            vertical_accuracy_mm=0xFFFF_FFFF,
            time_accuracy_ns=0xFFFF_FFFF,
            **dilution,
        )
    utc = calendar(sample.utc_ns, UTC_VALID)
    east, north, up = p.velocity_enu_mps
    speed = math.hypot(east, north)
    return GnssPvt(
        itow_ms=itow_ms(sample.utc_ns),
        year=utc.year,
        month=utc.month,
        day=utc.day,
        hour=utc.hour,
        minute=utc.minute,
        second=utc.second,
        valid=UTC_VALID,
        time_accuracy_ns=5,
        nanosecond=utc.nanosecond,
        fix=3,
        flags=1,
        satellites=p.satellites,
        reserved=0,
        lon_1e7deg=round(p.longitude_deg * 1e7),
        lat_1e7deg=round(p.latitude_deg * 1e7),
        height_mm=round(p.height_m * 1000),
        height_msl_mm=round((p.height_m - 18.0) * 1000),
        horizontal_accuracy_mm=round(p.horizontal_accuracy_m * 1000),
        vertical_accuracy_mm=round(p.vertical_accuracy_m * 1000),
        velocity_north_mmps=round(north * 1000),
        velocity_east_mmps=round(east * 1000),
        velocity_down_mmps=round(-up * 1000),
        ground_speed_mmps=round(speed * 1000),
        heading_of_motion_1e5deg=round(math.degrees(math.atan2(east, north)) * 1e5),
        speed_accuracy_mmps=300,
        heading_accuracy_1e5deg=500_000,
        heading_of_vehicle_1e5deg=0,
        geometric_dop_1e2=180,
        position_dop_1e2=150,
        time_dop_1e2=90,
        vertical_dop_1e2=120,
        horizontal_dop_1e2=80,
        northing_dop_1e2=60,
        easting_dop_1e2=50,
    )


def legacy_message(codec: LegacyCodec, sample: Sample, count: int, fix_age: int, fix_utc_ns: int) -> bytes:
    """Data of an MTData message.

    count       the 16-bit sample counter
    fix_age     samples since the receiver's newest solution, which was of fix_utc_ns
    """
    layout, p = codec.layout, sample.estimate
    local_from_enu = LOCAL_FROM_ENU[layout.local_frame]
    rotation: Floats = local_from_enu @ sample.enu_from_sensor
    flat = tuple(rotation.ravel().tolist())
    orientation = {QUATERNION: quaternion_of_matrix(flat), EULER: euler_deg(rotation), MATRIX: flat}
    velocity_enu_mps = p.velocity_enu_mps if p else (0.0, 0.0, 0.0)
    return codec.encode(
        LegacyData(
            raw_inertial=(32768,) * 10,
            raw_gps=_raw_gps(sample.place, fix_age, fix_utc_ns),
            temperature_c=31.5,
            acceleration_mps2=tuple(sample.force_mps2.tolist()),
            rate_radps=tuple(sample.rate_radps.tolist()),
            magnetic_field=_magnetic(sample),
            orientation=orientation[layout.orientation] if layout.mode & Mode.ORIENTATION else None,
            analog=(0,) * layout.analog_inputs,
            position=(p.latitude_deg, p.longitude_deg, p.height_m) if p else (0.0, 0.0, 0.0),
            velocity_mps=tuple((local_from_enu @ np.array(velocity_enu_mps)).tolist()),
            status=status_word(sample) & 0xFF,
            sample_counter=count,
            utc=_utc(sample)._replace(valid=int(sample.utc_known)),
        )
    )


def _raw_gps(p: Place | None, age: int, utc_ns: int) -> RawGps:
    age = min(age, 255)
    if p is None:
        return RawGps(50_662, 0, itow_ms(utc_ns), 0, 0, 0, 0, 0, 0, NO_FIX, NO_FIX, NO_FIX, age)
    east, north, up = p.velocity_enu_mps
    return RawGps(
        pressure_2pa=50_662,
        pressure_age=0,
        itow_ms=itow_ms(utc_ns),
        lat_1e7deg=round(p.latitude_deg * 1e7),
        lon_1e7deg=round(p.longitude_deg * 1e7),
        height_mm=round(p.height_m * 1000),
        velocity_north_cmps=round(north * 100),
        velocity_east_cmps=round(east * 100),
        velocity_down_cmps=round(-up * 100),
        horizontal_accuracy_mm=round(p.horizontal_accuracy_m * 1000),
        vertical_accuracy_mm=round(p.vertical_accuracy_m * 1000),
        speed_accuracy_cmps=30,
        age=age,
    )


NO_FIX = 0xFFFF_FFFF
