"""Payloads of the LUX: scans, commands and replies, errors and warnings. No I/O, no units but the wire's.

Angles are in ticks, of which `ticks_per_turn` (11520) make a turn, counter-clockwise, 0 straight ahead.

Sources: Ibeo SDK 6.0.4 (ScanImporter2202.cpp, CommandId.hpp); SICKAG/libsick_ldmrs, LuxBase.cpp and .hpp
(decodeScan, decodeErrorMessage, parameter and command codes); astuff/ibeo_core, ErrorWarning::parse.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from drivers.errors import ProtocolError

TICKS_PER_TURN = 11_520
TICKS_PER_DEG = 32
SCAN_HEADER_BYTES = 44
POINT_BYTES = 10
POINT = np.dtype(
    [
        ("layer_echo", "u1"),  # low nibble layer 0 (lowest) to 3, high nibble echo 0 to 2
        ("flags", "u1"),  # PointFlag; the upper four bits are reserved and set in real data
        ("angle_ticks", "<i2"),
        ("range_cm", "<u2"),
        ("width_cm", "<u2"),  # of the echo pulse
        ("segment", "<u2"),
    ]
)
REFUSED = 0x8000
PARAMETER_SIGN = 1 << 15
SYNC_ANGLE_MASK = 0x3FFF

_SCAN = struct.Struct("<3HQQH2hH3h3hH")
_STATUS = struct.Struct("<3H4s4H3H3H")
_ERRORS = struct.Struct("<4H")


class ScannerStatus(IntFlag):
    MOTOR_ON = 0x0001
    LASER_ON = 0x0002
    FREQUENCY_REACHED = 0x0008
    SYNC_SEEN = 0x0010
    SYNC_OK = 0x0020
    SYNC_MASTER = 0x0040
    UPSIDE_DOWN = 0x8000


class ScanFlag(IntFlag):
    GROUND_LABELLED = 0x0001
    DIRT_LABELLED = 0x0002
    RAIN_LABELLED = 0x0004
    TRANSPARENT_LABELLED = 0x0020
    REAR_MIRROR_SIDE = 0x0400


class PointFlag(IntFlag):
    """Set at random where the scan's flag does not report that this labelling ran."""

    TRANSPARENT = 0x01
    RAIN = 0x02
    GROUND = 0x04
    DIRT = 0x08


LABELS: Mapping[str, tuple[PointFlag, ScanFlag]] = {
    "transparent": (PointFlag.TRANSPARENT, ScanFlag.TRANSPARENT_LABELLED),
    "rain": (PointFlag.RAIN, ScanFlag.RAIN_LABELLED),
    "ground": (PointFlag.GROUND, ScanFlag.GROUND_LABELLED),
    "dirt": (PointFlag.DIRT, ScanFlag.DIRT_LABELLED),
}


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep of the mirror, data type 0x2202."""

    number: int  # 16 bits
    status: int  # ScannerStatus
    start_ntp: int  # when the mirror passed start_ticks
    end_ntp: int
    start_ticks: int
    end_ticks: int  # below start_ticks: the mirror sweeps from left to right
    points: npt.NDArray[np.void]  # (N,) of POINT, read-only
    flags: int = 0  # ScanFlag
    announced_points: int = -1  # by its header, N or more; -1: N
    sync_phase: int = 0  # 409.6 ns a count
    ticks_per_turn: int = TICKS_PER_TURN
    mounting_ticks: tuple[int, int, int] = (0, 0, 0)  # yaw, pitch, roll as stored in the device
    mounting_cm: tuple[int, int, int] = (0, 0, 0)  # x, y, z as stored in the device
    spare_bytes: int = 0  # behind the points announced, or a part of a point

    @property
    def is_truncated(self) -> bool:
        return self.announced_points > len(self.points)


def read_scan(payload: bytes) -> Scan:
    """Decode the points that came, be they fewer than announced. Raises ProtocolError without a header."""
    if len(payload) < SCAN_HEADER_BYTES:
        raise ProtocolError(
            f"a scan of {counted(len(payload), 'byte')}, its header alone has {SCAN_HEADER_BYTES}"
        )
    *head, yaw, pitch, roll, x, y, z, flags = _SCAN.unpack_from(payload)
    number, status, sync_phase, start_ntp, end_ntp, ticks_per_turn, start_ticks, end_ticks, announced = head
    count = min(announced, (len(payload) - SCAN_HEADER_BYTES) // POINT_BYTES)
    return Scan(
        number=number,
        status=status,
        start_ntp=start_ntp,
        end_ntp=end_ntp,
        start_ticks=start_ticks,
        end_ticks=end_ticks,
        points=np.frombuffer(payload, POINT, count, SCAN_HEADER_BYTES),
        flags=flags,
        announced_points=announced,
        sync_phase=sync_phase,
        ticks_per_turn=ticks_per_turn,
        mounting_ticks=(yaw, pitch, roll),
        mounting_cm=(x, y, z),
        spare_bytes=len(payload) - SCAN_HEADER_BYTES - POINT_BYTES * count,
    )


def write_scan(scan: Scan) -> bytes:
    """The payload, without spare bytes."""
    announced = len(scan.points) if scan.announced_points < 0 else scan.announced_points
    header = _SCAN.pack(
        scan.number,
        scan.status,
        scan.sync_phase,
        scan.start_ntp,
        scan.end_ntp,
        scan.ticks_per_turn,
        scan.start_ticks,
        scan.end_ticks,
        announced,
        *scan.mounting_ticks,
        *scan.mounting_cm,
        scan.flags,
    )
    return header + scan.points.tobytes()


class Command(IntEnum):
    RESET = 0x0000  # the only one without a reply
    GET_STATUS = 0x0001
    FILTER_OF_ECU = 0x0005
    SAVE_CONFIG = 0x0004
    SET_PARAMETER = 0x0010
    GET_PARAMETER = 0x0011
    RESET_PARAMETERS = 0x001A
    START = 0x0020
    STOP = 0x0021
    SET_NTP_SECONDS = 0x0030
    SET_NTP_FRACTION = 0x0031
    SET_NTP = 0x0034  # newer firmware


class Parameter(IntEnum):
    DATA_OUTPUT = 0x1012  # a bit set switches off: bit 0 scans, 2 objects, 4 errors and warnings
    START_ANGLE = 0x1100  # ticks, 16 bits signed in the lower half
    END_ANGLE = 0x1101
    SCAN_FREQUENCY = 0x1102  # 1/256 Hz
    SYNC_ANGLE = 0x1103  # ticks, 14 bits
    RESOLUTION = 0x1104  # 0 focused, 1 constant, 2 by sector
    UPSIDE_DOWN = 0x1109
    BEAM_TILT = 0x3302  # 1/10000 rad, 16 bits signed; not 0 on eight-layer units
    OPERATING_MINUTES = 0x3500
    FLEXRES_ERROR = 0x7000


@dataclass(frozen=True, slots=True)
class Reply:
    command: int
    refused: bool
    body: bytes


def write_command(command: int, body: bytes = b"") -> bytes:
    return struct.pack("<2H", command, 0) + body


def read_command(payload: bytes) -> tuple[int, bytes]:
    """Command and what follows its version. Raises ProtocolError."""
    if len(payload) < 4:
        raise ProtocolError(f"a command of {counted(len(payload), 'byte')}, the shortest has 4")
    return int.from_bytes(payload[:2], "little"), payload[4:]


def write_reply(command: int, body: bytes = b"", refused: bool = False) -> bytes:
    return struct.pack("<H", command | (REFUSED if refused else 0)) + body


def read_reply(payload: bytes) -> Reply:
    """Raises ProtocolError."""
    if len(payload) < 2:
        raise ProtocolError(f"a reply of {counted(len(payload), 'byte')}, the shortest has 2")
    code = int.from_bytes(payload[:2], "little")
    return Reply(code & ~REFUSED, bool(code & REFUSED), payload[2:])


def write_parameter(index: int, value: int) -> bytes:
    """Body of Set parameter and of the reply to Get parameter; a negative value is coded in 16 bits."""
    return struct.pack("<HI", index, value & 0xFFFF if value < 0 else value)


def read_parameter(body: bytes) -> tuple[int, int]:
    """Index and value, unsigned. Raises ProtocolError."""
    if len(body) < 6:
        raise ProtocolError(f"a parameter of {counted(len(body), 'byte')}, it has 6")
    index, value = struct.unpack_from("<HI", body)
    return int(index), int(value)


def signed_16(value: int) -> int:
    """A parameter's lower half as a signed number."""
    return ((value & 0xFFFF) ^ PARAMETER_SIGN) - PARAMETER_SIGN


def write_ntp_part(value: int) -> bytes:
    """Body of Set NTP seconds and of Set NTP fraction."""
    return struct.pack("<HI", 0, value)


def write_ntp(ntp: int) -> bytes:
    """Body of Set NTP."""
    return struct.pack("<HII", 0, ntp >> 32, ntp & 0xFFFF_FFFF)


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """Reply to Get status, without its command."""

    firmware_code: int
    fpga_code: int
    status: int  # ScannerStatus
    reserved: bytes
    temperature_raw: int
    serial_code: tuple[int, int, int]
    fpga_time_code: tuple[int, int, int]
    firmware_time_code: tuple[int, int, int]

    @classmethod
    def read(cls, body: bytes) -> "DeviceStatus":
        """Raises ProtocolError."""
        if len(body) < _STATUS.size:
            raise ProtocolError(f"a status of {counted(len(body), 'byte')}, it has {_STATUS.size}")
        firmware, fpga, status, reserved, temperature, *rest = _STATUS.unpack_from(body)
        return cls(
            *(firmware, fpga, status, reserved, temperature),
            serial_code=(rest[0], rest[1], rest[2]),
            fpga_time_code=(rest[3], rest[4], rest[5]),
            firmware_time_code=(rest[6], rest[7], rest[8]),
        )

    def write(self) -> bytes:
        return _STATUS.pack(
            *(self.firmware_code, self.fpga_code, self.status, self.reserved, self.temperature_raw),
            *self.serial_code,
            *self.fpga_time_code,
            *self.firmware_time_code,
        )

    @property
    def firmware(self) -> str:
        """Firmware version as the vendor prints it: 0x3021 is 3.02.1."""
        code = self.firmware_code
        version = f"{code >> 12:x}.{code >> 4 & 0xFF:02x}.{code & 0xF:x}"
        year, day, minute = self.firmware_time_code
        if 0xFFFF in self.firmware_time_code:
            return version
        return f"{version} {year:04x}-{day >> 8:02x}-{day & 0xFF:02x} {minute >> 8:02x}:{minute & 0xFF:02x}"

    @property
    def serial(self) -> str:
        """Year, week and counter, or a hardware address, by the third word."""
        first, second, third = self.serial_code
        if first == 0xFFFF:
            return ""
        return f"{first:04x}-{second}" if third & 0xFF == 1 else f"{first:04X}{second:04X}{third:04X}"

    @property
    def temperature_c(self) -> float | None:
        """None where it is not measured, as some units while scanning. Formula of the Ibeo SDK."""
        if self.temperature_raw > 1568:
            return None
        return (579.2364 - self.temperature_raw) / 3.63


ERROR_WORDS_1 = {
    0x0001: "internal error",
    0x0002: "motor 1 fault",
    0x0004: "scan buffer sent incompletely",
    0x0008: "scan buffer overflow",
    0x0400: "motor 2 fault",
    0x0800: "motor 3 fault",
    0x1000: "motor 4 fault",
    0x2000: "motor 5 fault",
}
ERROR_WORDS_2 = {
    0x0001: "no scan data",
    0x0002: "internal communication error",
    0x0004: "bad scan data",
    0x0008: "FPGA not configurable",
    0x0010: "bad configuration data",
    0x0020: "bad parameter in the configuration",
    0x0040: "processing timeout",
    0x0080: "environment model reset",
    0x0200: "bad FlexRes configuration",
}
WARNING_WORDS_1 = {
    0x0001: "internal communication",
    0x0008: "low temperature",
    0x0010: "high temperature",
    0x0020: "motor",
    0x0080: "check synchronisation or scan frequency",
    0x1000: "start pulse of laser 1 missing",
    0x2000: "start pulse of laser 2 missing",
}
WARNING_WORDS_2 = {
    0x0001: "CAN blocked",
    0x0002: "Ethernet blocked",
    0x0004: "bad CAN message",
    0x0008: "bad scan data",
    0x0010: "incomplete or unknown Ethernet data",
    0x0020: "wrong or forbidden command",
    0x0040: "memory access",
    0x0080: "overflow",
    0x0100: "ego motion missing",
    0x0200: "bad mounting parameters",
    0x0400: "no objects at this scan frequency",
}
_APD_TEMPERATURE = 0x0300


@dataclass(frozen=True, slots=True)
class ErrorRegisters:
    """Data type 0x2030."""

    errors_1: int = 0
    errors_2: int = 0
    warnings_1: int = 0
    warnings_2: int = 0

    @classmethod
    def read(cls, payload: bytes) -> "ErrorRegisters":
        """Raises ProtocolError."""
        if len(payload) < _ERRORS.size:
            raise ProtocolError(
                f"errors and warnings in {counted(len(payload), 'byte')}, at least {_ERRORS.size} expected"
            )
        return cls(*_ERRORS.unpack_from(payload))

    def write(self) -> bytes:
        registers = (self.errors_1, self.errors_2, self.warnings_1, self.warnings_2)
        return _ERRORS.pack(*registers) + bytes(8)

    @property
    def error_words(self) -> list[str]:
        words = _words(self.errors_1 & ~_APD_TEMPERATURE, ERROR_WORDS_1, "error register 1")
        words += _words(self.errors_2, ERROR_WORDS_2, "error register 2")
        apd = self.errors_1 & _APD_TEMPERATURE
        if apd == _APD_TEMPERATURE:
            words.append("APD temperature sensor defective")
        elif apd:  # which of the two bits means too cold and which too hot, the sources disagree about
            words.append(f"APD temperature out of range (register 0x{apd:04x})")
        return words

    @property
    def warning_words(self) -> list[str]:
        words = _words(self.warnings_1, WARNING_WORDS_1, "warning register 1")
        return words + _words(self.warnings_2, WARNING_WORDS_2, "warning register 2")


def _words(register: int, names: Mapping[int, str], register_name: str) -> list[str]:
    """A name for each bit, so that their number is bounded."""
    bits = [1 << place for place in range(16) if register & 1 << place]
    return [names.get(bit, f"{register_name} bit 0x{bit:04x}") for bit in bits]
