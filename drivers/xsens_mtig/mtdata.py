"""Contents of legacy MTData: a fixed layout that follows from OutputMode and OutputSettings.

Sources: MT0100P, MT0137P (MTi-G); cmtpacket.cpp of the CMT SDK and parse_MTData of ethzasl_xsens_driver,
which agree on the order; checked on traces of an MTi-G.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

from drivers.counted import counted
from drivers.errors import ProtocolError
from drivers.xsens_mtig.mtdata2 import LocalFrame, Utc, read_utc, write_utc
from drivers.xsens_mtig.reals import BYTES, Precision, Reals, read_reals, write_reals

UTC_BYTES = 12


class Mode(IntEnum):
    """OutputMode, message D0: single bits. Plain numbers, because they are read in each message."""

    TEMPERATURE = 0x0001
    CALIBRATED = 0x0002
    ORIENTATION = 0x0004
    AUXILIARY = 0x0008
    POSITION = 0x0010
    VELOCITY = 0x0020
    STATUS = 0x0800
    RAW_GPS = 0x1000
    RAW_INERTIAL = 0x4000


class Settings(IntEnum):
    """OutputSettings, message D2: single bits. Bits 3-2 are the orientation, bits 9-8 the number format."""

    SAMPLE_COUNTER = 0x0001
    UTC = 0x0002
    NO_ACCELERATION = 0x0010
    NO_RATE = 0x0020
    NO_MAGNETIC_FIELD = 0x0040
    NO_ANALOG_1 = 0x0400
    NO_ANALOG_2 = 0x0800
    NED = 0x8000_0000


ORIENTATION_SHIFT, PRECISION_SHIFT = 2, 8
QUATERNION, EULER, MATRIX = range(3)
ORIENTATION_REALS = (4, 3, 9)
KNOWN_MODE = sum(Mode)

_RAW_INERTIAL = struct.Struct(">10H")
_RAW_GPS = struct.Struct(">HBIiiiiiiIIIB")


class RawGps(NamedTuple):
    """The receiver's own solution. Ages count samples since the value was new; 0 is new in this sample."""

    pressure_2pa: int  # in steps of 2 Pa
    pressure_age: int
    itow_ms: int
    lat_1e7deg: int
    lon_1e7deg: int
    height_mm: int  # above the ellipsoid
    velocity_north_cmps: int
    velocity_east_cmps: int
    velocity_down_cmps: int
    horizontal_accuracy_mm: int
    vertical_accuracy_mm: int
    speed_accuracy_cmps: int
    age: int


@dataclass(frozen=True, slots=True)
class LegacyData:
    """One MTData decoded; None is what the layout leaves out. SI units but for degrees where stated."""

    raw_inertial: tuple[int, ...] | None = None  # acc xyz, gyr xyz, mag xyz, temperature; ADC counts
    raw_gps: RawGps | None = None
    temperature_c: float | None = None
    acceleration_mps2: Reals | None = None
    rate_radps: Reals | None = None
    magnetic_field: Reals | None = None  # 1 = the field at calibration
    orientation: Reals | None = None  # quaternion w x y z; or roll, pitch, yaw, deg; or matrix row by row
    analog: tuple[int, ...] | None = None
    position: Reals | None = None  # latitude deg, longitude deg, height m
    velocity_mps: Reals | None = None
    status: int | None = None
    sample_counter: int | None = None
    utc: Utc | None = None


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the data that a device in this mode with these settings sends."""

    mode: int
    settings: int

    @property
    def precision(self) -> Precision:
        return Precision(self.settings >> PRECISION_SHIFT & 3)

    @property
    def orientation(self) -> int:
        """QUATERNION, EULER or MATRIX. Raises ProtocolError where the bits indicate neither."""
        kind = self.settings >> ORIENTATION_SHIFT & 3
        if kind > MATRIX:
            raise ProtocolError(f"output settings 0x{self.settings:08X}: orientation format 3 does not exist")
        return kind

    @property
    def local_frame(self) -> LocalFrame:
        return LocalFrame.NED if self.settings & Settings.NED else LocalFrame.NWU

    @property
    def analog_inputs(self) -> int:
        if not self.mode & Mode.AUXILIARY:
            return 0
        return 2 - sum(bool(self.settings & bit) for bit in (Settings.NO_ANALOG_1, Settings.NO_ANALOG_2))

    def parts(self) -> list["Part"]:
        """In their order in the data. Raises ProtocolError for a layout that cannot be."""
        mode, settings, calibrated = self.mode, self.settings, self.mode & Mode.CALIBRATED
        orientation = ORIENTATION_REALS[self.orientation] if mode & Mode.ORIENTATION else 0
        analog = struct.Struct(f">{self.analog_inputs}H")
        table = (
            (mode & Mode.RAW_INERTIAL, _tuple("raw_inertial", _RAW_INERTIAL)),
            (mode & Mode.RAW_GPS, _tuple("raw_gps", _RAW_GPS, RawGps._make)),
            (mode & Mode.TEMPERATURE, self._reals("temperature_c", 1)),
            (calibrated and not settings & Settings.NO_ACCELERATION, self._reals("acceleration_mps2", 3)),
            (calibrated and not settings & Settings.NO_RATE, self._reals("rate_radps", 3)),
            (calibrated and not settings & Settings.NO_MAGNETIC_FIELD, self._reals("magnetic_field", 3)),
            (orientation, self._reals("orientation", orientation)),
            (self.analog_inputs, _tuple("analog", analog)),
            (mode & Mode.POSITION, self._reals("position", 3)),
            (mode & Mode.VELOCITY, self._reals("velocity_mps", 3)),
            (mode & Mode.STATUS, _number("status", ">B")),
            (settings & Settings.SAMPLE_COUNTER, _number("sample_counter", ">H")),
            (settings & Settings.UTC, Part("utc", UTC_BYTES, read_utc, write_utc)),
        )
        return [part for is_there, part in table if is_there]

    def _reals(self, name: str, count: int) -> "Part":
        """One number or several."""
        precision = self.precision

        def read(data: bytes, at: int) -> Any:
            values = read_reals(data, precision, count, at)
            return values[0] if count == 1 else values

        def write(value: Any) -> bytes:
            return write_reals((value,) if count == 1 else value, precision)

        return Part(name, count * BYTES[precision], read, write)

    @property
    def data_bytes(self) -> int:
        """Length of the data, by which a device's own word for it is checked. Raises ProtocolError."""
        return sum(part.size for part in self.parts())


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the data: an attribute of LegacyData. read takes the data and where the part begins."""

    name: str
    size: int
    read: Callable[[bytes, int], Any]
    write: Callable[[Any], bytes]


def _tuple(name: str, layout: struct.Struct, make: Callable[[Any], Any] = tuple) -> Part:
    return Part(
        name,
        layout.size,
        lambda data, at: make(layout.unpack_from(data, at)),
        lambda value: layout.pack(*value),
    )


def _number(name: str, code: str) -> Part:
    layout = struct.Struct(code)
    return Part(name, layout.size, lambda data, at: layout.unpack_from(data, at)[0], layout.pack)


class LegacyCodec:
    """MTData of one layout, both directions. Raises ProtocolError for a layout that cannot be."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._parts = layout.parts()
        self._data_bytes = layout.data_bytes

    def decode(self, data: bytes) -> LegacyData:
        """Raises ProtocolError where the data have not the layout's length."""
        if len(data) != self._data_bytes:
            raise ProtocolError(
                f"MTData of {counted(len(data), 'byte')}, mode 0x{self.layout.mode:04X} with settings "
                f"0x{self.layout.settings:08X} makes {self._data_bytes}"
            )
        found, at = {}, 0
        for part in self._parts:
            found[part.name] = part.read(data, at)
            at += part.size
        return LegacyData(**found)

    def encode(self, sample: LegacyData) -> bytes:
        """The inverse of decode; what the layout leaves out is left out. Raises ValueError where a part is
        missing."""
        data = b""
        for part in self._parts:
            value = getattr(sample, part.name)
            if value is None:
                raise ValueError(f"{part.name} is missing, the layout has it")
            data += part.write(value)
        return data
