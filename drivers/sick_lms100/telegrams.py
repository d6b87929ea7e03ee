"""Telegrams of the scanners of models.py, field by field; one layout for both dialects and directions.

Source: SICK Telegram Listing 8014631; LMS500 manual 8013796, annex (LMDscandata); checked against a recorded
LMS111 (V1.80.2), LMS511, TiM551 and TiM781S. Device units: 1/10000 deg (e4deg), 1/100 Hz (chz), us.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drivers.errors import ProtocolError
from drivers.rates import same_rate
from drivers.sick_lms100.models import LMS1XX, MODELS
from drivers.sick_lms100.protocol import Dialect, Reader, Telegram, Writer, reader, writer

MAX_BEAMS = max(model.max_beams for model in MODELS.values())
MAX_CHANNELS = 8
MAX_ENCODERS = 4

ANGLE_SLACK_E4DEG = 100
FULL_TURN_E4DEG = 3_600_000

STATE_READY = 7
STATES = {
    0: "undefined",
    1: "initialising",
    2: "being configured",
    3: "idle",
    4: "spinning up",
    5: "in preparation",
    6: "ready, laser off",
    7: "measuring",
}
SCAN_CONFIG_ERRORS = {
    1: "scan rate not possible",
    2: "angle step not possible",
    3: "angle step and field of view not possible",
    4: "field of view not possible",
    5: "other error",
}
CONTAMINATION = {
    0: "clean",
    1: "contamination warning",
    2: "contamination error",
    3: "contamination error, no longer measuring",
}
LOW_CODES = {0: "no_echo", 1: "dazzled", 2: "implausible", 3: "filtered"}  # 4 to 15 are reserved
FIRST_RANGE_CODE = 16


def exact_step_deg(step_e4deg: int) -> float:
    """A step above 0 that is an integer fraction of a turn is stated rounded: 3333 for a third of a
    degree.
    """
    exact_e4deg = FULL_TURN_E4DEG / round(FULL_TURN_E4DEG / step_e4deg)
    return (exact_e4deg if abs(exact_e4deg - step_e4deg) <= 0.5 else step_e4deg) / 10_000


@dataclass(frozen=True, slots=True)
class ScanConfig:
    """LMPscancfg: how fast it turns and how finely it measures."""

    frequency_chz: int
    step_e4deg: int
    first_e4deg: int = LMS1XX.first_e4deg
    last_e4deg: int = LMS1XX.last_e4deg
    sectors: int = 1

    def write(self, w: Writer) -> None:
        w.u32(self.frequency_chz)
        w.u16(self.sectors)
        w.u32(self.step_e4deg)
        w.i32(self.first_e4deg, self.last_e4deg)

    @property
    def words(self) -> str:
        return f"{self.frequency_chz / 100.0:g} Hz and {self.step_e4deg / 1e4:g} deg"

    def agrees(self, other: "ScanConfig") -> bool:
        """Same rate, which a unit may state as measured, and same step."""
        return same_rate(self.frequency_chz, other.frequency_chz) and self.step_e4deg == other.step_e4deg

    @classmethod
    def read(cls, r: Reader) -> "ScanConfig":
        frequency_chz, sectors, step_e4deg = r.u32(), r.u16(), r.u32()
        return cls(frequency_chz, step_e4deg, r.i32(), r.i32(), sectors)


@dataclass(frozen=True, slots=True)
class OutputRange:
    """LMPoutputRange: which part of the sweep is sent. The LMS1xx reports step 5000 whatever it really is."""

    first_e4deg: int
    last_e4deg: int
    step_e4deg: int = 5000

    def write(self, w: Writer) -> None:
        w.u16(1)
        w.u32(self.step_e4deg)
        w.i32(self.first_e4deg, self.last_e4deg)

    @classmethod
    def read(cls, r: Reader) -> "OutputRange":
        r.u16()
        step_e4deg = r.u32()
        return cls(r.i32(), r.i32(), step_e4deg)

    @property
    def words(self) -> str:
        """The range as text, angles as in the config: 0 straight ahead, left positive."""
        return f"{self.first_e4deg / 1e4 - 90.0:g} to {self.last_e4deg / 1e4 - 90.0:g} deg"

    def agrees(self, other: "OutputRange", slack_e4deg: int = 0) -> bool:
        """Same angles to 0.01 deg and the slack: SOPAS ET stores -449997 where -450000 was meant."""
        most_e4deg = ANGLE_SLACK_E4DEG + slack_e4deg
        return (
            abs(self.first_e4deg - other.first_e4deg) <= most_e4deg
            and abs(self.last_e4deg - other.last_e4deg) <= most_e4deg
        )


@dataclass(frozen=True, slots=True)
class ScanDataConfig:
    """LMDscandatacfg: which parts a scan telegram has."""

    echoes: int  # 1 first, 2 second, 3 both
    remission: bool
    remission_16bit: bool
    time: bool = True
    encoder: int = 0
    position: bool = False
    name: bool = False
    comment: bool = False
    interval: int = 1  # every n-th scan is sent

    @property
    def words(self) -> str:
        echoes = {1: "first echo", 2: "second echo", 3: "both echoes"}.get(
            self.echoes, f"echoes {self.echoes}"
        )
        bits = (16 if self.remission_16bit else 8) if self.remission else 0
        sent = "every scan" if self.interval == 1 else f"one scan in {self.interval}"
        return f"{echoes}, intensity_bits {bits}, {sent}"

    def write(self, w: Writer) -> None:
        w.u8(self.echoes, 0, self.remission, self.remission_16bit, 0, self.encoder, 0)
        w.u8(self.position, self.name, self.comment, self.time)
        w.u16(self.interval)

    @classmethod
    def read(cls, r: Reader) -> "ScanDataConfig":
        echoes = r.u8()
        r.u8()
        remission, remission_16bit = r.u8() != 0, r.u8() != 0
        r.u8()  # unit: digits, nothing else
        encoder = r.u8()
        r.u8()
        position, name, comment, time = (r.u8() != 0 for _ in range(4))
        return cls(echoes, remission, remission_16bit, time, encoder, position, name, comment, r.u16())


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """STlms. The date may hold blanks, so it is read by its length; what follows differs between dialects."""

    state: int
    too_hot_or_cold: bool
    clock: str  # hh:mm:ss
    date: str  # dd.mm.yyyy

    def write(self, w: Writer, dialect: Dialect) -> None:
        w.u16(self.state)
        w.u8(self.too_hot_or_cold)
        w.text(self.clock)
        w.text(self.date)
        w.u16(0, 0, 0)
        if dialect is Dialect.BINARY:
            w.u16(0, 0, 0)

    @classmethod
    def read(cls, r: Reader) -> "DeviceStatus":
        return cls(r.u16(), r.u8() != 0, r.text(), r.text())


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One row of numbers, beam by beam. value * scale + offset is mm for DIST, device units for RSSI."""

    content: str  # DIST1 DIST2 RSSI1 RSSI2 ANGL1
    values: npt.NDArray[np.uint16]  # (N,)
    first_e4deg: int
    step_e4deg: int
    scale: float = 1.0
    offset: float = 0.0

    @property
    def makes_numbers(self) -> bool:
        """Whether scale and offset make numbers of the values that float32 holds, the larger the farther."""
        largest = abs(self.scale) * 0xFFFF + abs(self.offset)
        return self.scale > 0.0 and largest <= float(np.finfo(np.float32).max)

    @property
    def last_e4deg(self) -> int:
        return self.first_e4deg + round(exact_step_deg(self.step_e4deg) * 10_000 * (len(self.values) - 1))

    def part(self, beams: slice) -> "Channel":
        """Some of its beams; the slice has neither None nor a step."""
        first_e4deg = self.first_e4deg + self.step_e4deg * beams.start
        return replace(self, values=self.values[beams], first_e4deg=first_e4deg)


@dataclass(frozen=True, slots=True)
class Calendar:
    """The device's calendar; starts at 1970-01-01 with each power-on where no NTP is set up."""

    year: int
    month: int
    day: int
    hour: int
    minute: int
    second: int
    microsecond: int


@dataclass(frozen=True, slots=True)
class Event:
    kind: str  # four letters, e.g. FDIN
    encoder: int
    time_us: int
    angle_e4deg: int


@dataclass(frozen=True, slots=True, eq=False)
class ScanTelegram:
    """LMDscandata. Field numbers of the listing's table follow the order of the attributes."""

    serial_number: int
    status: tuple[int, int]  # bit 0 error, 1 contamination warning, 2 contamination error; either byte
    telegram_counter: int  # 16 bits
    scan_counter: int  # 16 bits; runs ahead of the telegrams where scans are left out
    start_us: int  # 32 bits since power-on: the zero index
    sent_us: int  # 32 bits since power-on: handed to the network
    frequency_chz: int
    shots_100hz: int  # measurement frequency in 100 Hz; some firmware sends 100 times that
    channels_16bit: tuple[Channel, ...]
    channels_8bit: tuple[Channel, ...] = ()
    inputs: tuple[int, int] = (0, 0)
    outputs: tuple[int, int] = (0, 0)
    encoders: tuple[tuple[int, int], ...] = ()  # position, speed
    position: tuple[float, ...] | None = None  # x y z, rotation x y z, type
    name: str | None = None
    comment: str | None = None
    time: Calendar | None = None
    event: Event | None = None
    version: int = 1
    device_number: int = 1
    layer_angle: int = 0

    def channel(self, content: str) -> Channel | None:
        """The channel of this content, or None where it was not sent."""
        return next((c for c in self.channels_16bit + self.channels_8bit if c.content == content), None)


def write_scan(scan: ScanTelegram, dialect: Dialect, kind: str = "sSN") -> Telegram:
    """kind: sSN for an event, sRA for the answer to a poll."""
    w = writer(dialect)
    w.u16(scan.version, scan.device_number)
    w.u32(scan.serial_number)
    w.u8(*scan.status)
    w.u16(scan.telegram_counter, scan.scan_counter)
    w.u32(scan.start_us, scan.sent_us)
    w.u8(*scan.inputs, *scan.outputs)
    w.u16(scan.layer_angle)
    w.u32(scan.frequency_chz, scan.shots_100hz)
    w.u16(len(scan.encoders))
    for encoder_position, speed in scan.encoders:
        w.u32(encoder_position)
        w.u16(speed)
    for channels, bits in ((scan.channels_16bit, 16), (scan.channels_8bit, 8)):
        w.u16(len(channels))
        for channel in channels:
            _write_channel(w, channel, bits)
    w.u16(scan.position is not None)
    if scan.position is not None:
        w.f32(*scan.position[:6])
        w.u8(int(scan.position[6]))
    for text in (scan.name, scan.comment):
        w.u16(text is not None)
        if text is not None:
            w.text(text)
    write_calendar(w, scan.time)
    w.u16(scan.event is not None)
    if scan.event is not None:
        w.characters(scan.event.kind)
        w.u32(scan.event.encoder, scan.event.time_us)
        w.i32(scan.event.angle_e4deg)
    return Telegram(dialect, kind, "LMDscandata", w.body)


def read_scan(telegram: Telegram) -> ScanTelegram:
    """Raises ProtocolError where the body is not a scan."""
    r = reader(telegram)
    version, device_number, serial_number = r.u16(), r.u16(), r.u32()
    status = (r.u8(), r.u8())
    telegram_counter, scan_counter, start_us, sent_us = r.u16(), r.u16(), r.u32(), r.u32()
    inputs, outputs = (r.u8(), r.u8()), (r.u8(), r.u8())
    layer_angle, frequency_chz, shots_100hz = r.u16(), r.u32(), r.u32()
    encoders = tuple((r.u32(), r.u16()) for _ in range(_at_most(r.u16(), MAX_ENCODERS, "encoders")))
    channels_16bit = _read_channels(r, 16)
    channels_8bit = _read_channels(r, 8)
    position = (*(r.f32() for _ in range(6)), float(r.u8())) if r.u16() else None
    name = r.text() if r.u16() else None
    comment = r.text() if r.u16() else None
    time = read_calendar(r)
    event = None
    if not r.at_end and r.u16():
        event = Event(r.characters(4), r.u32(), r.u32(), r.i32())
    return ScanTelegram(
        serial_number=serial_number,
        status=status,
        telegram_counter=telegram_counter,
        scan_counter=scan_counter,
        start_us=start_us,
        sent_us=sent_us,
        frequency_chz=frequency_chz,
        shots_100hz=shots_100hz,
        channels_16bit=channels_16bit,
        channels_8bit=channels_8bit,
        inputs=inputs,
        outputs=outputs,
        encoders=encoders,
        position=position,
        name=name,
        comment=comment,
        time=time,
        event=event,
        version=version,
        device_number=device_number,
        layer_angle=layer_angle,
    )


def write_calendar(w: Writer, time: Calendar | None) -> None:
    """The flag, and the calendar where there is one."""
    w.u16(time is not None)
    if time is not None:
        w.u16(time.year)
        w.u8(time.month, time.day, time.hour, time.minute, time.second)
        w.u32(time.microsecond)


def read_calendar(r: Reader) -> Calendar | None:
    """Reads the flag, and the calendar where there is one."""
    if not r.u16():
        return None
    return Calendar(r.u16(), r.u8(), r.u8(), r.u8(), r.u8(), r.u8(), r.u32())


def _write_channel(w: Writer, channel: Channel, bits: int) -> None:
    w.characters(channel.content)
    w.f32(channel.scale, channel.offset)
    w.i32(channel.first_e4deg)
    w.u16(channel.step_e4deg, len(channel.values))
    w.array(channel.values, bits)


def _read_channels(r: Reader, bits: int) -> tuple[Channel, ...]:
    channels = []
    for _ in range(_at_most(r.u16(), MAX_CHANNELS, f"channels of {bits} bits")):
        content, scale, offset, first_e4deg, step_e4deg = r.characters(5), r.f32(), r.f32(), r.i32(), r.u16()
        values = r.array(_at_most(r.u16(), MAX_BEAMS, "beams"), bits)
        channels.append(Channel(content, values, first_e4deg, step_e4deg, scale, offset))
    return tuple(channels)


def _at_most(count: int, limit: int, what: str) -> int:
    if count > limit:
        raise ProtocolError(f"{count} {what} in a scan telegram, at most {limit} are possible")
    return count
