"""Messages of the IBEO LUX, which is the SICK LD-MRS too: bytes <-> type and payload. No I/O, no clock.

A message is a header of 24 bytes, big endian, and a payload, little endian. There is no checksum: what guards
the stream is the magic word, a plausible type and a bounded size. A size corrupted in transit shows by the
next message's header lying inside the payload announced; then the message is given up, not those it would
swallow.

Sources: Ibeo SDK 6.0.4, IbeoDataHeader.cpp; SICKAG/libsick_ldmrs, LuxBase.cpp (buildDataHeader,
decodeAnswerInInputBuffer).
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

from drivers.errors import ProtocolError

MAGIC = b"\xaf\xfe\xc0\xc2"
HEADER_BYTES = 24
MAX_MESSAGE_BYTES = 131_072  # 4 layers, 3 echoes, 110 deg in steps of 0.125 deg are 105 644
MAX_GARBAGE_BYTES = 262_144  # in a row; one fault cannot damage two of the largest messages
NTP_UNIX_S = 2_208_988_800  # from 1900-01-01 to 1970-01-01
NTP_MODULUS = 1 << 64

_HEADER = struct.Struct(">4sIIBBHQ")


class DataType(IntEnum):
    COMMAND = 0x2010
    REPLY = 0x2020
    ERRORS = 0x2030
    SCAN = 0x2202
    SCAN_ECU = 0x2204
    SCAN_FUSION = 0x2205
    SCAN_MINILUX = 0x2208
    SCAN_SCALA = 0x2209
    OBJECTS = 0x2221
    VEHICLE_STATE = 0x2805
    VEHICLE_STATE_ECU = 0x2806
    LOG_ERROR = 0x6400
    LOG_WARNING = 0x6410
    LOG_NOTE = 0x6420
    LOG_DEBUG = 0x6430
    SENSOR_INFO = 0x7100


FOREIGN_SCANS: dict[int, str] = {
    DataType.SCAN_ECU: "an Ibeo ECU",
    DataType.SCAN_FUSION: "an Ibeo fusion ECU",
    DataType.SCAN_MINILUX: "a MiniLUX",
    DataType.SCAN_SCALA: "a Scala",
}


@dataclass(frozen=True, slots=True)
class Message:
    data_type: int
    payload: bytes
    device_id: int = 7  # of the sender's choice; receivers must not depend on it
    ntp: int = 0  # of sending, 32.32 bit seconds since 1900; 0 where the sender does not state it
    previous_bytes: int = 0  # used in files only


def encode(message: Message) -> bytes:
    """Raises ValueError where the payload is larger than any decoder would take."""
    if len(message.payload) > MAX_MESSAGE_BYTES:
        raise ValueError(
            f"a payload of {len(message.payload)} bytes, at most {MAX_MESSAGE_BYTES} are possible"
        )
    header = _HEADER.pack(
        MAGIC,
        message.previous_bytes,
        len(message.payload),
        0,
        message.device_id,
        message.data_type,
        message.ntp,
    )
    return header + message.payload


class Decoder:
    """Feed bytes as they come; take messages as they become complete. Keeps at most one message and one
    read.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._looked = len(MAGIC)  # how far the message at the front was searched for another header
        self._belongs = 0  # bytes at the front that were the tail of a payload and may still begin a header
        self._garbage_in_a_row = 0
        self.skipped_bytes = 0
        self.bad_headers = 0  # magic word, but no plausible type or size behind it
        self.cut_messages = 0  # given up because the next header came before their end

    def receive_data(self, data: bytes) -> list[Message]:
        """Raises ProtocolError where nothing looks like a message for MAX_GARBAGE_BYTES."""
        self._buffer += data
        messages = []
        while (message := self._next()) is not None:
            messages.append(message)
            self._garbage_in_a_row = 0
        if self._garbage_in_a_row > MAX_GARBAGE_BYTES:
            raise ProtocolError(
                f"{self._garbage_in_a_row} bytes without a message; is this port 12002 of a LUX or an LD-MRS?"
            )
        return messages

    def _next(self) -> Message | None:
        buffer = self._buffer
        while True:
            start = buffer.find(MAGIC)
            if start < 0:
                self._skip(len(buffer) - _unfinished_magic(buffer))
                return None
            self._skip(start)
            if len(buffer) < HEADER_BYTES:
                return None
            _, previous_bytes, size, _, device_id, data_type, ntp = _HEADER.unpack_from(buffer)
            if not _is_plausible(size, data_type):
                self.bad_headers += 1
                self._skip(1)
                continue
            end = HEADER_BYTES + size
            inner = self._find_header_before(end)
            if inner:
                self.cut_messages += 1
                self._skip(inner)
                continue
            if inner is None or len(buffer) < end:
                return None
            payload = bytes(buffer[HEADER_BYTES:end])
            self._belongs = _unfinished_magic(payload)
            del buffer[: end - self._belongs]
            self._looked = len(MAGIC)
            return Message(data_type, payload, device_id, ntp, previous_bytes)

    def _find_header_before(self, end: int) -> int | None:
        """Where another plausible header begins before `end`; 0 if none does, None if it is not all there."""
        buffer = self._buffer
        while (place := buffer.find(MAGIC, self._looked, end + len(MAGIC) - 1)) >= 0:
            if len(buffer) < place + HEADER_BYTES:
                self._looked = place
                return None
            _, _, size, _, _, data_type, _ = _HEADER.unpack_from(buffer, place)
            if _is_plausible(size, data_type):
                return place
            self._looked = place + 1
        self._looked = max(self._looked, min(len(buffer), end) - len(MAGIC) + 1)
        return 0

    def _skip(self, count: int) -> None:
        if count <= 0:
            return
        del self._buffer[:count]
        foreign = max(count - self._belongs, 0)
        self._belongs = max(self._belongs - count, 0)
        self.skipped_bytes += foreign
        self._garbage_in_a_row += foreign
        self._looked = len(MAGIC)


def _is_plausible(size: int, data_type: int) -> bool:
    """An unknown type is no fault: it is skipped by its size."""
    return size <= MAX_MESSAGE_BYTES and 0x1000 <= data_type < 0x8000


def _unfinished_magic(data: bytes | bytearray) -> int:
    """Number of bytes at the end that may be the beginning of a magic word."""
    for count in (3, 2, 1):
        if data.endswith(MAGIC[:count]):
            return count
    return 0


def ntp_from_unix_ns(unix_ns: int) -> int:
    """The 64-bit stamp; its era of 136 years, which began in 1900, is left out."""
    seconds, ns = divmod(unix_ns, 1_000_000_000)
    return ((seconds + NTP_UNIX_S) << 32 | (ns << 32) // 1_000_000_000) % NTP_MODULUS


def ntp_difference_ns(later: int, earlier: int) -> int:
    """Signed; right over the end of an era (2036-02-07) as well."""
    difference = (later - earlier + NTP_MODULUS // 2) % NTP_MODULUS - NTP_MODULUS // 2
    return (difference * 1_000_000_000 + (1 << 31)) >> 32
