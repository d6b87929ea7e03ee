"""iRobot Open Interface, bytes <-> fields, both directions. No ports, no clock, no units.

Sources: iRobot Create 2 Open Interface Specification based on Roomba 600 (2016); iRobot Create Open
Interface v2 (2006). Values are big endian. A stream frame is `13 | n | id data id data ... | checksum`, and
all its bytes, header and checksum included, sum to 0 modulo 256.
"""

import re
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

from drivers.counted import counted
from drivers.errors import ProtocolError

FRAME_HEADER = 0x13
FRAME_PERIOD_NS = 15_000_000
MODE_SWITCH_NS = 100_000_000  # 128 requires 20 ms before the next command; libraries leave more
BANNER_END_NS = 1_000_000_000  # so much quiet, and the robot has sent all of its text after a reset
MAX_LIST = 255  # the count byte of 148 and 149
LONGEST_TEXT_LINE = 256  # a banner line is shorter; more is noise that happens to be printable
SHORTEST_TEXT = 6  # so many printable bytes in a row are text; fewer are data that look like it


class Opcode(IntEnum):
    RESET = 7
    START = 128
    BAUD = 129
    CONTROL = 130
    SAFE = 131
    FULL = 132
    POWER = 133
    SPOT = 134
    CLEAN = 135  # Create 1: cover
    MAX = 136  # Create 1: demo, one data byte
    DRIVE = 137
    MOTORS = 138
    LEDS = 139
    SONG = 140
    PLAY = 141
    SENSORS = 142
    DOCK = 143
    PWM_MOTORS = 144
    DRIVE_DIRECT = 145
    DRIVE_PWM = 146
    DIGITAL_OUTPUTS = 147
    STREAM = 148
    QUERY_LIST = 149
    PAUSE_RESUME_STREAM = 150
    SEND_IR = 151
    SCRIPT = 152
    PLAY_SCRIPT = 153
    SHOW_SCRIPT = 154
    WAIT_TIME = 155
    WAIT_DISTANCE = 156
    WAIT_ANGLE = 157
    WAIT_EVENT = 158
    SCHEDULING_LEDS = 162
    DIGIT_LEDS_RAW = 163
    DIGIT_LEDS_ASCII = 164
    BUTTONS = 165
    SCHEDULE = 167
    SET_DAY_TIME = 168
    STOP = 173


class Mode(IntEnum):
    OFF = 0
    PASSIVE = 1
    SAFE = 2
    FULL = 3


class PacketId(IntEnum):
    """The packets this project reads by name; PACKETS has them all."""

    BUMPS_WHEEL_DROPS = 7
    CLIFF_LEFT = 9
    CLIFF_FRONT_LEFT = 10
    CLIFF_FRONT_RIGHT = 11
    CLIFF_RIGHT = 12
    DISTANCE = 19
    ANGLE = 20
    CHARGING_STATE = 21
    VOLTAGE = 22
    CURRENT = 23
    TEMPERATURE = 24
    BATTERY_CHARGE = 25
    BATTERY_CAPACITY = 26
    CHARGING_SOURCES = 34
    OI_MODE = 35
    STREAM_PACKETS = 38
    REQUESTED_VELOCITY = 39
    REQUESTED_RADIUS = 40
    REQUESTED_RIGHT_VELOCITY = 41
    REQUESTED_LEFT_VELOCITY = 42
    LEFT_ENCODER = 43
    RIGHT_ENCODER = 44


# id -> struct code. The encoders are called signed in the manual; read modulo 2^16 the sign is nothing.
_CODES = (
    *("BBBBBBBBBBBB", "hhBHhbHH"),  # 7 bumps to 18 buttons; 19 distance to 26 battery capacity
    *("HHHHHBH", "BBBBB"),  # 27 wall signal to 33; 34 charging sources to 38 stream packets
    *("hhhhHH", "BHHHHHHBB"),  # 39 requested velocity to 44 right encoder; 45 light bumper to 53
    "hhhhB",  # 54 motor currents to 58 stasis
)
PACKETS: dict[int, str] = dict(zip(range(7, 59), "".join(_CODES), strict=True))

# The answer to a group is the plain concatenation of its packets, without ids.
GROUPS: dict[int, range] = {
    0: range(7, 27),
    1: range(7, 17),
    2: range(17, 21),
    3: range(21, 27),
    4: range(27, 35),
    5: range(35, 43),
    6: range(7, 43),
    100: range(7, 59),
    101: range(43, 59),
    106: range(46, 52),
    107: range(54, 59),
}

_DATA_BYTES: dict[int, int] = {
    **dict.fromkeys(Opcode, 0),
    **dict.fromkeys(
        (
            Opcode.BAUD,
            Opcode.MOTORS,
            Opcode.PLAY,
            Opcode.SENSORS,
            Opcode.DIGITAL_OUTPUTS,
            Opcode.PAUSE_RESUME_STREAM,
            Opcode.SEND_IR,
            Opcode.WAIT_TIME,
            Opcode.WAIT_EVENT,
            Opcode.BUTTONS,
        ),
        1,
    ),
    Opcode.WAIT_DISTANCE: 2,
    Opcode.WAIT_ANGLE: 2,
    Opcode.SCHEDULING_LEDS: 2,
    Opcode.LEDS: 3,
    Opcode.PWM_MOTORS: 3,
    Opcode.SET_DAY_TIME: 3,
    Opcode.DRIVE: 4,
    Opcode.DRIVE_DIRECT: 4,
    Opcode.DRIVE_PWM: 4,
    Opcode.DIGIT_LEDS_RAW: 4,
    Opcode.DIGIT_LEDS_ASCII: 4,
    Opcode.SCHEDULE: 15,
}


def members(packet_id: int) -> Sequence[int]:
    """The packets behind an id: those of a group, or the packet itself. Raises ProtocolError if unknown."""
    if packet_id in GROUPS:
        return GROUPS[packet_id]
    if packet_id not in PACKETS:
        raise ProtocolError(
            f"sensor packet {packet_id} does not exist; 7 to 58 and the groups {list(GROUPS)} do"
        )
    return (packet_id,)


def _code(packet_id: int) -> str:
    return "".join(PACKETS[member] for member in members(packet_id))


@lru_cache(maxsize=256)  # a robot sends one list all the time
def _layout(packet_ids: tuple[int, ...]) -> struct.Struct:
    """struct layout of the plain answer to these ids."""
    return struct.Struct(">" + "".join(_code(packet_id) for packet_id in packet_ids))


def data_bytes(packet_ids: Iterable[int]) -> int:
    """Length of the plain answer to 142 or 149 for these ids. Raises ProtocolError where one is unknown."""
    return _layout(tuple(packet_ids)).size


def frame_bytes(packet_ids: Sequence[int]) -> int:
    """Length of a complete stream frame of these ids."""
    return 3 + len(packet_ids) + data_bytes(packet_ids)


def encode_stream_request(packet_ids: Sequence[int]) -> bytes:
    """148: send these packets every 15 ms, the first time 15 ms from now. An empty list ends the stream."""
    return _encode_list(Opcode.STREAM, packet_ids)


def encode_query(packet_ids: Sequence[int]) -> bytes:
    """149: answer once with these packets, in this order, without ids, length or checksum."""
    return _encode_list(Opcode.QUERY_LIST, packet_ids)


def _encode_list(opcode: Opcode, packet_ids: Sequence[int]) -> bytes:
    if len(packet_ids) > MAX_LIST:
        raise ProtocolError(f"{len(packet_ids)} packets in one {opcode.name} request; at most {MAX_LIST} fit")
    for packet_id in packet_ids:
        members(packet_id)
    return bytes([opcode, len(packet_ids), *packet_ids])


def encode_values(packet_ids: Sequence[int], values: Mapping[int, int]) -> bytes:
    """The plain answer to 142 or 149: values[packet] of each id in turn; a packet not in `values` is 0."""
    flat = [values.get(member, 0) for packet_id in packet_ids for member in members(packet_id)]
    return _layout(tuple(packet_ids)).pack(*flat)


def decode_values(packet_ids: Sequence[int], data: bytes) -> dict[int, int]:
    """Inverse of encode_values. A packet requested twice keeps its last value.

    Raises ProtocolError where the length does not fit.
    """
    expected = data_bytes(packet_ids)
    if len(data) != expected:
        raise ProtocolError(
            f"answer of {counted(len(data), 'byte')} to packets {list(packet_ids)}, expected {expected}"
        )
    flat = _layout(tuple(packet_ids)).unpack(data)
    order = [member for packet_id in packet_ids for member in members(packet_id)]
    return dict(zip(order, flat, strict=True))


def encode_frame(packet_ids: Sequence[int], values: Mapping[int, int]) -> bytes:
    """A stream frame; `values` as in encode_values. Raises ProtocolError beyond 255 bytes of content."""
    body = b"".join(bytes([packet_id]) + encode_values([packet_id], values) for packet_id in packet_ids)
    if len(body) > 255:
        raise ProtocolError(f"stream frame of {len(body)} content bytes; its count byte ends at 255")
    frame = bytes([FRAME_HEADER, len(body)]) + body
    return frame + bytes([-sum(frame) & 0xFF])


@dataclass(frozen=True, slots=True)
class StreamFrame:
    """One good frame."""

    values: dict[int, int]  # by packet id
    bytes_after: int  # bytes of the same read that came behind it
    damaged_bytes_before: int  # bytes since the last good frame that were neither frame nor text


class StreamDecoder:
    """Feed bytes as they come; take the frames of one requested list as they become complete.

    A frame counts only if its length, its ids in the order requested and its checksum fit, because the
    header's value is common inside data. Anything else is skipped from header + 1 on, and counted. Runs of
    printable characters among the skipped bytes are the robot's own messages: they gather in `lines`, which
    the caller empties. Never raises, never holds more than one frame and one line of text.
    """

    def __init__(self, packet_ids: Sequence[int]) -> None:
        self._packet_ids = tuple(packet_ids)
        self._length = frame_bytes(packet_ids)
        if not 4 <= self._length <= 258:
            raise ProtocolError(f"packets {list(packet_ids)} do not make a stream frame")
        self._struct = struct.Struct(">" + "".join("B" + _code(packet_id) for packet_id in packet_ids))
        self._id_at: list[tuple[int, int]] = []  # (offset in the frame, id that stands there)
        offset = 2
        for packet_id in packet_ids:
            self._id_at.append((offset, packet_id))
            offset += 1 + data_bytes([packet_id])
        self._buffer = bytearray()
        self._text = TextCollector()
        self._skipped_since_frame = 0
        self._text_bytes_at_frame = 0
        self.bytes_skipped = 0
        self.checksum_failures = 0

    @property
    def lines(self) -> list[str]:
        return self._text.lines

    @property
    def text_bytes(self) -> int:
        """Number of skipped bytes that were text."""
        return self._text.text_bytes

    def receive_data(self, data: bytes) -> list[StreamFrame]:
        self._buffer += data
        buffer, frames, at = self._buffer, list[StreamFrame](), 0
        while at < len(buffer):
            if not self._may_begin(at):
                self._skip(buffer[at])
                at += 1
            elif len(buffer) - at < self._length:
                break
            elif sum(buffer[at : at + self._length]) & 0xFF:
                self.checksum_failures += 1
                self._skip(buffer[at])
                at += 1
            else:
                end = at + self._length
                frames.append(self._frame(bytes(buffer[at + 2 : end - 1]), len(buffer) - end))
                at = end
        del buffer[:at]
        return frames

    def _may_begin(self, at: int) -> bool:
        """Whether the bytes from `at` on could still become a frame."""
        buffer = self._buffer
        if buffer[at] != FRAME_HEADER:
            return False
        if at + 1 < len(buffer) and buffer[at + 1] != self._length - 3:
            return False
        return all(
            buffer[at + offset] == packet_id for offset, packet_id in self._id_at if at + offset < len(buffer)
        )

    def _frame(self, body: bytes, bytes_after: int) -> StreamFrame:
        self._text.interrupt()
        text_bytes = self._text.text_bytes - self._text_bytes_at_frame
        damaged = max(self._skipped_since_frame - text_bytes, 0)
        self._skipped_since_frame, self._text_bytes_at_frame = 0, self._text.text_bytes
        fields = iter(self._struct.unpack(body))
        values = {}
        for packet_id in self._packet_ids:
            next(fields)  # the id, checked already
            for member in members(packet_id):
                values[member] = next(fields)
        return StreamFrame(values, bytes_after, damaged)

    def _skip(self, byte: int) -> None:
        self.bytes_skipped += 1
        self._skipped_since_frame += 1
        self._text.add(byte)


class TextCollector:
    """Picks lines of text out of bytes that are not data. `lines` is emptied by the caller."""

    MAX_LINES = 64

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.text_bytes = 0
        self._run = bytearray()
        self._line_ended = False

    def add(self, byte: int) -> None:
        if 0x20 <= byte < 0x7F or byte == 0x09:
            self._run.append(byte)
            if len(self._run) >= LONGEST_TEXT_LINE:
                self.interrupt()
        elif byte in (0x0A, 0x0D):
            if self._run:
                self._run.append(byte)
                self._line_ended = self.interrupt()
            elif self._line_ended:  # the other half of the line's end
                self.text_bytes += 1
        else:
            self.interrupt()

    def interrupt(self) -> bool:
        """Close the run: a line if it is long enough, else bytes that only looked like text."""
        self._line_ended = False
        is_text = len(self._run) >= SHORTEST_TEXT
        if is_text:
            self.text_bytes += len(self._run)
            line = self._run.decode("ascii").strip()
            if line and len(self.lines) < self.MAX_LINES:
                self.lines.append(line)
        self._run.clear()
        return is_text


_BANNER_MARKS = ("bl-start", "bootloader", "roomba by irobot", "r3_robot", "stm32", "str730")
_FIRMWARE = re.compile(r"r3_robot/tags/(?:release-)?([\w.:\-]+)|(\d{4}-\d{2}-\d{2}-\d{4}-\w)")


def is_banner(line: str) -> bool:
    """Whether a line belongs to what a robot prints when it starts after a reset or a new battery."""
    return any(mark in line.lower() for mark in _BANNER_MARKS)


def banner_identity(line: str) -> dict[str, str]:
    """Identity that a line of the banner states: `firmware`, `bootloader`; empty for other lines."""
    if match := _FIRMWARE.search(line):
        return {"firmware": match[1]} if match[1] else {"bootloader": match[2]}
    return {}


@dataclass(frozen=True, slots=True)
class Command:
    """One complete command as the robot receives it."""

    opcode: Opcode
    data: bytes = b""


class CommandDecoder:
    """The robot's side: consumes exactly the data bytes of each opcode and waits for those still missing.

    Bytes that are no opcode are ignored, as the robot does. Songs and lists hold at most 255 entries.
    """

    def __init__(self, demo_takes_data: bool = False) -> None:
        self._demo_takes_data = demo_takes_data  # 136 on a Create 1
        self._buffer = bytearray()

    def receive_data(self, data: bytes) -> list[Command]:
        self._buffer += data
        commands = []
        while self._buffer:
            if self._buffer[0] not in _DATA_BYTES:
                del self._buffer[0]
                continue
            opcode = Opcode(self._buffer[0])
            needed = self._needed(opcode)
            if needed is None or len(self._buffer) < 1 + needed:
                break
            commands.append(Command(opcode, bytes(self._buffer[1 : 1 + needed])))
            del self._buffer[: 1 + needed]
        return commands

    def _needed(self, opcode: Opcode) -> int | None:
        """Data bytes of the command at the buffer's start; None where that is not known yet."""
        match opcode:
            case Opcode.STREAM | Opcode.QUERY_LIST | Opcode.SCRIPT:
                return 1 + self._buffer[1] if len(self._buffer) > 1 else None
            case Opcode.SONG:
                return 2 + 2 * self._buffer[2] if len(self._buffer) > 2 else None
            case Opcode.MAX if self._demo_takes_data:
                return 1
            case _:
                return _DATA_BYTES[opcode]
