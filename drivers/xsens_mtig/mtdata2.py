"""Contents of MTData2: items `id (2) | size (1) | payload`, in any order, any of them missing at any time.

An id holds what it is (upper 12 bits), the number format (bits 1-0) and the local frame (bits 3-2).
Source: MT0101P, MTData2 and its tables of data identifiers. Checked on recordings of an MTi-G-710.
"""

import struct
from collections.abc import Iterable
from enum import IntEnum
from typing import NamedTuple

from drivers.counted import counted
from drivers.errors import ProtocolError
from drivers.xsens_mtig.reals import BYTES, Reals, read_reals, write_reals

KIND_MASK, FRAME_MASK, PRECISION_MASK = 0xFFF0, 0x000C, 0x0003
MAX_ITEMS = 32  # of an output configuration
EVERY_MESSAGE = 0xFFFF  # in place of a rate


class Kind(IntEnum):
    """Data identifiers without format and frame."""

    TEMPERATURE = 0x0810
    UTC = 0x1010
    PACKET_COUNTER = 0x1020
    SAMPLE_TIME_FINE = 0x1060
    SAMPLE_TIME_COARSE = 0x1070
    QUATERNION = 0x2010
    MATRIX = 0x2020
    EULER = 0x2030
    PRESSURE = 0x3010
    DELTA_V = 0x4010
    ACCELERATION = 0x4020
    FREE_ACCELERATION = 0x4030
    ACCELERATION_HR = 0x4040
    ALTITUDE = 0x5020
    ECEF = 0x5030
    LAT_LON = 0x5040
    GNSS_PVT = 0x7010
    GNSS_SATELLITES = 0x7020
    RATE = 0x8020
    DELTA_Q = 0x8030
    RATE_HR = 0x8040
    RAW_INERTIAL = 0xA010
    RAW_GYRO_TEMPERATURES = 0xA020
    MAGNETIC_FIELD = 0xC020
    VELOCITY = 0xD010
    STATUS_BYTE = 0xE010
    STATUS_WORD = 0xE020
    DEVICE_ID = 0xE080
    LOCATION_ID = 0xE090


class LocalFrame(IntEnum):
    """Local frame, bits 3-2 of the id of an orientation or a velocity."""

    ENU = 0x0
    NED = 0x4
    NWU = 0x8


REALS_OF = {
    Kind.TEMPERATURE: 1,
    Kind.QUATERNION: 4,
    Kind.MATRIX: 9,
    Kind.EULER: 3,
    Kind.DELTA_V: 3,
    Kind.ACCELERATION: 3,
    Kind.FREE_ACCELERATION: 3,
    Kind.ACCELERATION_HR: 3,
    Kind.ALTITUDE: 1,
    Kind.ECEF: 3,
    Kind.LAT_LON: 2,
    Kind.RATE: 3,
    Kind.DELTA_Q: 4,
    Kind.RATE_HR: 3,
    Kind.MAGNETIC_FIELD: 3,
    Kind.VELOCITY: 3,
}
_INTEGERS = {
    Kind.PACKET_COUNTER: struct.Struct(">H"),
    Kind.SAMPLE_TIME_FINE: struct.Struct(">I"),
    Kind.SAMPLE_TIME_COARSE: struct.Struct(">I"),
    Kind.PRESSURE: struct.Struct(">I"),
    Kind.STATUS_BYTE: struct.Struct(">B"),
    Kind.STATUS_WORD: struct.Struct(">I"),
}
_UTC = struct.Struct(">IHBBBBBB")
_PVT = struct.Struct(">IHBBBBBBIiBBBBiiiiIIiiiiiIIi7H")
_ITEM = struct.Struct(">HB")
_RATE = struct.Struct(">HH")


class Utc(NamedTuple):
    """valid: bit 0 date, bit 1 time of day, bit 2 leap seconds known. Legacy: 1 all, 2 time of day alone."""

    nanosecond: int
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    valid: int


class GnssPvt(NamedTuple):
    """Position, velocity, time of the receiver; integers as on the wire, no fix: see `fix` and `flags`."""

    itow_ms: int
    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    valid: int  # as Utc.valid
    time_accuracy_ns: int
    nanosecond: int  # signed: the time is this much off the full second
    fix: int  # 0 none, 1 dead reckoning, 2 and 3 dimensions, 4 these with dead reckoning, 5 time alone
    flags: int  # bit 0 fix is good, bit 1 differential, bit 5 heading of the vehicle is good
    satellites: int
    reserved: int
    lon_1e7deg: int
    lat_1e7deg: int
    height_mm: int  # above the ellipsoid
    height_msl_mm: int
    horizontal_accuracy_mm: int
    vertical_accuracy_mm: int
    velocity_north_mmps: int
    velocity_east_mmps: int
    velocity_down_mmps: int
    ground_speed_mmps: int
    heading_of_motion_1e5deg: int
    speed_accuracy_mmps: int
    heading_accuracy_1e5deg: int
    heading_of_vehicle_1e5deg: int
    geometric_dop_1e2: int
    position_dop_1e2: int
    time_dop_1e2: int
    vertical_dop_1e2: int
    horizontal_dop_1e2: int
    northing_dop_1e2: int
    easting_dop_1e2: int


Value = Reals | int | Utc | GnssPvt | bytes


def split(data: bytes) -> list[tuple[int, bytes]]:
    """(id, payload) of each item in the order sent. Raises ProtocolError where an item is cut off."""
    items = []
    at, end = 0, len(data)
    while at < end:
        if at + 3 > end or at + 3 + data[at + 2] > end:
            raise ProtocolError(f"item at byte {at} of {end} runs over the end of its message")
        payload_at = at + 3
        at = payload_at + data[at + 2]
        items.append((data[payload_at - 3] << 8 | data[payload_at - 2], data[payload_at:at]))
    return items


def join(items: Iterable[tuple[int, bytes]]) -> bytes:
    """Data of an MTData2 message. Raises struct.error where a payload is longer than 255 bytes."""
    return b"".join(_ITEM.pack(identifier, len(payload)) + payload for identifier, payload in items)


def read_item(identifier: int, payload: bytes) -> Value:
    """Raises ProtocolError where the payload has not the size its id demands. Unknown ids stay bytes."""
    kind = identifier & KIND_MASK
    count = REALS_OF.get(kind)  # type: ignore[call-overload]
    if count is not None:
        precision = identifier & PRECISION_MASK
        _demand(kind, payload, count * BYTES[precision])
        return read_reals(payload, precision, count)
    integer = _INTEGERS.get(kind)  # type: ignore[call-overload]
    if integer is not None:
        _demand(kind, payload, integer.size)
        (value,) = integer.unpack(payload)
        return int(value)
    if kind == Kind.UTC:
        return read_utc(payload)
    if kind == Kind.GNSS_PVT:
        _demand(kind, payload, _PVT.size)
        return GnssPvt._make(_PVT.unpack(payload))
    return payload


def write_item(identifier: int, value: Value) -> bytes:
    """Raises ValueError where a value does not fit its id."""
    kind = identifier & KIND_MASK
    if isinstance(value, bytes):
        return value
    if isinstance(value, Utc):
        return write_utc(value)
    if isinstance(value, GnssPvt):
        return _PVT.pack(*value)
    if isinstance(value, int):
        return _INTEGERS[Kind(kind)].pack(value)
    if len(value) != REALS_OF[Kind(kind)]:
        raise ValueError(
            f"{counted(len(value), 'number')} for {Kind(kind).name}, it has {REALS_OF[Kind(kind)]}"
        )
    return write_reals(value, identifier & PRECISION_MASK)


def item_bytes(identifier: int) -> int:
    """On the wire, with id and size. Raises KeyError for kinds whose size is not fixed or not known."""
    kind = Kind(identifier & KIND_MASK)
    if kind in REALS_OF:
        return _ITEM.size + REALS_OF[kind] * BYTES[identifier & PRECISION_MASK]
    sizes = {Kind.UTC: _UTC.size, Kind.GNSS_PVT: _PVT.size}
    return _ITEM.size + (sizes[kind] if kind in sizes else _INTEGERS[kind].size)


def read_utc(payload: bytes, offset: int = 0) -> Utc:
    """Raises ProtocolError where there are no 12 bytes."""
    if len(payload) - offset < _UTC.size:
        raise ProtocolError(f"{counted(len(payload) - offset, 'byte')} of UTC time, expected {_UTC.size}")
    return Utc._make(_UTC.unpack_from(payload, offset))


def write_utc(utc: Utc) -> bytes:
    return _UTC.pack(*utc)


def read_output_configuration(data: bytes) -> list[tuple[int, int]]:
    """(id, rate in Hz or EVERY_MESSAGE) as configured or acknowledged. Raises ProtocolError."""
    if len(data) % _RATE.size:
        raise ProtocolError(
            f"output configuration of {counted(len(data), 'byte')}, expected a multiple of {_RATE.size}"
        )
    return [(identifier, rate) for identifier, rate in _RATE.iter_unpack(data)]


def write_output_configuration(wanted: Iterable[tuple[int, int]]) -> bytes:
    return b"".join(_RATE.pack(identifier, rate) for identifier, rate in wanted)


def _demand(kind: int, payload: bytes, size: int) -> None:
    if len(payload) != size:
        raise ProtocolError(f"{counted(len(payload), 'byte')} of {Kind(kind).name}, expected {size}")
