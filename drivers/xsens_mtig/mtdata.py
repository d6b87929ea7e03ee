"""Contents of legacy MTData: a fixed layout that follows from OutputMode and OutputSettings.

Sources: MT0100P, MT0137P (MTi-G); cmtpacket.cpp of the CMT SDK and parse_MTData of ethzasl_xsens_driver,
which agree on the order; checked on traces of an MTi-G.
"""

import struct
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import NamedTuple

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

    def reals(self) -> list[tuple[str, int]]:
        """(attribute of LegacyData, how many numbers) before and after the analog inputs, in order."""
        mode, settings = self.mode, self.settings
        wanted: list[tuple[str, int, int]] = [("temperature_c", 1, mode & Mode.TEMPERATURE)]
        for name, switch in (
            ("acceleration_mps2", Settings.NO_ACCELERATION),
            ("rate_radps", Settings.NO_RATE),
            ("magnetic_field", Settings.NO_MAGNETIC_FIELD),
        ):
            wanted.append((name, 3, mode & Mode.CALIBRATED and not settings & switch))
        if mode & Mode.ORIENTATION:
            wanted.append(("orientation", ORIENTATION_REALS[self.orientation], 1))
        wanted.append(("position", 3, mode & Mode.POSITION))
        wanted.append(("velocity_mps", 3, mode & Mode.VELOCITY))
        return [(name, count) for name, count, there in wanted if there]

    @property
    def data_bytes(self) -> int:
        """Length of the data, by which a device's own word for it is checked. Raises ProtocolError."""
        total = sum(count for _, count in self.reals()) * BYTES[self.precision] + 2 * self.analog_inputs
        total += _RAW_INERTIAL.size if self.mode & Mode.RAW_INERTIAL else 0
        total += _RAW_GPS.size if self.mode & Mode.RAW_GPS else 0
        total += 1 if self.mode & Mode.STATUS else 0
        total += 2 if self.settings & Settings.SAMPLE_COUNTER else 0
        return total + (UTC_BYTES if self.settings & Settings.UTC else 0)


class LegacyCodec:
    """MTData of one layout, both directions. Raises ProtocolError for a layout that cannot be."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.data_bytes = layout.data_bytes
        before = ("temperature_c", "acceleration_mps2", "rate_radps", "magnetic_field", "orientation")
        reals = layout.reals()
        self._before = [(name, count) for name, count in reals if name in before]
        self._after = [(name, count) for name, count in reals if name not in before]
        self._precision = layout.precision
        self._analog = struct.Struct(f">{layout.analog_inputs}H")

    def decode(self, data: bytes) -> LegacyData:
        """Raises ProtocolError where the data have not the layout's length."""
        if len(data) != self.data_bytes:
            raise ProtocolError(
                f"MTData of {counted(len(data), 'byte')}, mode 0x{self.layout.mode:04X} with settings "
                f"0x{self.layout.settings:08X} makes {self.data_bytes}"
            )
        found: dict[str, object] = {}
        mode, settings, at = self.layout.mode, self.layout.settings, 0
        if mode & Mode.RAW_INERTIAL:
            found["raw_inertial"] = _RAW_INERTIAL.unpack_from(data)
            at += _RAW_INERTIAL.size
        if mode & Mode.RAW_GPS:
            found["raw_gps"] = RawGps._make(_RAW_GPS.unpack_from(data, at))
            at += _RAW_GPS.size
        at = self._read(self._before, data, at, found)
        if self._analog.size:
            found["analog"] = self._analog.unpack_from(data, at)
            at += self._analog.size
        at = self._read(self._after, data, at, found)
        if mode & Mode.STATUS:
            found["status"] = data[at]
            at += 1
        if settings & Settings.SAMPLE_COUNTER:
            found["sample_counter"] = data[at] << 8 | data[at + 1]
            at += 2
        if settings & Settings.UTC:
            found["utc"] = read_utc(data, at)
        return LegacyData(**found)  # type: ignore[arg-type]

    def _read(self, reals: list[tuple[str, int]], data: bytes, at: int, found: dict[str, object]) -> int:
        for name, count in reals:
            values = read_reals(data, self._precision, count, at)
            found[name] = values[0] if count == 1 else values
            at += count * BYTES[self._precision]
        return at

    def encode(self, sample: LegacyData) -> bytes:
        """The inverse of decode. Raises ValueError where the sample is not of this layout."""
        data = b""
        if sample.raw_inertial is not None:
            data += _RAW_INERTIAL.pack(*sample.raw_inertial)
        if sample.raw_gps is not None:
            data += _RAW_GPS.pack(*sample.raw_gps)
        data += self._write(self._before, sample)
        data += self._analog.pack(*(sample.analog or ()))
        data += self._write(self._after, sample)
        if sample.status is not None:
            data += bytes((sample.status,))
        if sample.sample_counter is not None:
            data += struct.pack(">H", sample.sample_counter)
        if sample.utc is not None:
            data += write_utc(sample.utc)
        if len(data) != self.data_bytes:
            given = [f.name for f in fields(sample) if getattr(sample, f.name) is not None]
            raise ValueError(f"{given} make {counted(len(data), 'byte')}, the layout has {self.data_bytes}")
        return data

    def _write(self, reals: list[tuple[str, int]], sample: LegacyData) -> bytes:
        data = b""
        for name, count in reals:
            value = getattr(sample, name)
            if value is None:
                raise ValueError(f"{name} is missing, the layout has it")
            data += write_reals((value,) if count == 1 else value, self._precision)
        return data
