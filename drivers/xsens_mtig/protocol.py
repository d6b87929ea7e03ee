"""Xsens MT messages, bytes <-> message, both directions. No ports, no clock.

`FA | bus id | message id | length | data | checksum`, big endian; length FF means that two more bytes give
it. All bytes but the first sum to 0 modulo 256. An acknowledgement is the request's id plus one.
Source: Xsens, MT Low Level Communication Protocol Documentation MT0101P, chapters 2, 4 and 5; for the MTi-G
of 2007 also cmtdef.h of the CMT SDK.
"""

import struct
from dataclasses import dataclass, field
from enum import IntEnum

PREAMBLE = 0xFA
MASTER = 0xFF  # a device that stands alone; it answers to 1 as well
BUS_IDS = (MASTER, 0x01)
EXTENDED = 0xFF  # in the length byte
MAX_SHORT_BYTES = 254
MAX_DATA_BYTES = 2048
OVERHEAD_BYTES = 5


class Mid(IntEnum):
    """Message ids of requests and events; the answer to a request has the next one."""

    REQ_DEVICE_ID = 0x00
    INIT_MT = 0x02
    PERIOD = 0x04
    REQ_DATA_LENGTH = 0x0A
    REQ_CONFIGURATION = 0x0C
    CONFIGURATION = 0x0D
    RESTORE_FACTORY_DEFAULTS = 0x0E
    GO_TO_MEASUREMENT = 0x10
    REQ_FIRMWARE = 0x12
    BAUDRATE = 0x18
    REQ_PRODUCT_CODE = 0x1C
    REQ_HARDWARE_VERSION = 0x1E
    NO_ROTATION = 0x22
    RUN_SELFTEST = 0x24
    SYNC_SETTINGS = 0x2C
    GO_TO_CONFIG = 0x30
    MTDATA = 0x32
    REQ_DATA = 0x34
    MTDATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    RESET = 0x40
    ERROR = 0x42
    WARNING = 0x43
    OPTION_FLAGS = 0x48
    UTC_TIME = 0x60
    REQ_SCENARIOS = 0x62
    SCENARIO = 0x64
    GRAVITY = 0x66
    LEVER_ARM = 0x68
    MAGNETIC_DECLINATION = 0x6A
    LAT_LON_ALT = 0x6E
    GNSS_PLATFORM = 0x76
    HEADING = 0x82
    LOCATION_ID = 0x84
    EXT_OUTPUT_MODE = 0x86
    STORE_XKF_STATE = 0x8A
    STRING_OUTPUT = 0x8E
    RESET_ORIENTATION = 0xA4
    GPS_STATUS = 0xA6
    ADJUST_UTC = 0xA8
    OUTPUT_CONFIGURATION = 0xC0
    OUTPUT_MODE = 0xD0
    OUTPUT_SETTINGS = 0xD2
    SKIP_FACTOR = 0xD4
    SYNC_IN = 0xD6
    SYNC_OUT = 0xD8
    ERROR_MODE = 0xDA
    TRANSMIT_DELAY = 0xDC
    OBJECT_ALIGNMENT = 0xE0
    ALIGNMENT_ROTATION = 0xEC


LONG_MIDS = frozenset(
    (Mid.MTDATA, Mid.MTDATA2, Mid.CONFIGURATION, Mid.REQ_SCENARIOS + 1, Mid.SYNC_SETTINGS + 1)
)

BAUD_OF_CODE = {
    0x00: 460_800,
    0x01: 230_400,
    0x02: 115_200,
    0x03: 76_800,
    0x04: 57_600,
    0x05: 38_400,
    0x06: 28_800,
    0x07: 19_200,
    0x08: 14_400,
    0x09: 9_600,
    0x0A: 921_600,
    0x0B: 4_800,
    0x0C: 2_000_000,
    0x0D: 4_000_000,
    0x0E: 3_686_400,
    0x80: 921_600,
}
# In the order of mtdevice.py of ethzasl_xsens_driver; units leave the factory at the first.
LIKELY_BAUDS = (115_200, 460_800, 921_600, 230_400, 57_600, 38_400, 19_200, 9_600)
CODE_OF_BAUD = {baud: code for code, baud in BAUD_OF_CODE.items()}  # 921 600 is requested by 80

UNSUPPORTED = 0x04
TIMER_OVERFLOW = 0x1E
BAUD_INVALID = 0x20
PARAMETER_INVALID = 0x21
DEVICE_ERROR = 0x28
DATA_OVERFLOW = 0x29
ERRORS = {
    0x01: "no reply from the bus",
    0x02: "bus communication failed",
    0x03: "output period not possible",
    UNSUPPORTED: "message invalid or not implemented",
    TIMER_OVERFLOW: "timer overflow: more data than the line carries at this rate",
    BAUD_INVALID: "baud rate not possible",
    PARAMETER_INVALID: "parameter invalid or out of range",
    0x23: "transmit buffer full",
    0x24: "transmit buffer overflow",
    0x25: "wireless failure",
    DEVICE_ERROR: "device error",
    DATA_OVERFLOW: "more data than the line carries",
    0x2A: "sample buffer full",
}
WARNINGS = {
    401: "the GNSS receiver refused its configuration",
    402: "no answer from the GNSS receiver",
    403: "communication with the GNSS receiver failed",
}


@dataclass(frozen=True, slots=True)
class Message:
    mid: int
    data: bytes = b""
    bus_id: int = MASTER
    bytes_after: int = field(default=0, compare=False)  # that were read together with this message's last

    @property
    def wire_bytes(self) -> int:
        return len(self.data) + OVERHEAD_BYTES + (2 if len(self.data) > MAX_SHORT_BYTES else 0)


def encode(mid: int, data: bytes = b"", bus_id: int = MASTER) -> bytes:
    """The message on the wire. Raises ValueError where the data are too long."""
    if len(data) > MAX_DATA_BYTES:
        raise ValueError(f"{len(data)} bytes of data, a message takes {MAX_DATA_BYTES}")
    if len(data) > MAX_SHORT_BYTES:
        body = struct.pack(">BBBH", bus_id, mid, EXTENDED, len(data)) + data
    else:
        body = bytes((bus_id, mid, len(data))) + data
    return bytes((PREAMBLE,)) + body + bytes((-sum(body) & 0xFF,))


class MessageDecoder:
    """Finds messages in a stream that may begin anywhere and be damaged anywhere; holds one message at most.

    After a bad checksum it goes on right behind the preamble it had taken: floats often hold FA FF, so it may
    have been none.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.skipped_bytes = 0
        self.bad_checksums = 0

    @property
    def waiting_bytes(self) -> int:
        """Number of bytes of an incomplete message."""
        return len(self._buffer)

    def receive_data(self, data: bytes) -> list[Message]:
        self._buffer += data
        messages: list[Message] = []
        buffer, at, end = self._buffer, 0, len(self._buffer)
        while at < end:
            if buffer[at] != PREAMBLE:
                found = buffer.find(PREAMBLE, at)
                found = end if found < 0 else found
                self.skipped_bytes += found - at
                at = found
                continue
            size = _message_bytes(buffer, at, end)
            if size is None or at + size > end:
                break
            if size and not sum(buffer[at + 1 : at + size]) & 0xFF:
                header = 6 if buffer[at + 3] == EXTENDED else 4
                content = bytes(buffer[at + header : at + size - 1])
                messages.append(Message(buffer[at + 2], content, buffer[at + 1], end - at - size))
                at += size
                continue
            if size:
                self.bad_checksums += 1
            self.skipped_bytes += 1
            at += 1
        del buffer[:at]
        return messages

    def give_up_waiting(self) -> list[Message]:
        """Discard an incomplete message and search again behind its preamble: for a line that
        has become silent. A preamble found in garbage may announce bytes that never come.
        """
        if not self._buffer:
            return []
        del self._buffer[0]
        self.skipped_bytes += 1
        return self.receive_data(b"")


def _message_bytes(buffer: bytearray, at: int, end: int) -> int | None:
    """Length of the message that begins at `at`; None: not known yet, 0: there is none."""
    if at + 1 < end and buffer[at + 1] not in BUS_IDS:
        return 0
    if at + 4 > end:
        return None
    length = buffer[at + 3]
    if length != EXTENDED:
        return length + OVERHEAD_BYTES
    if buffer[at + 2] not in LONG_MIDS:
        return 0
    if at + 6 > end:
        return None
    extended = buffer[at + 4] << 8 | buffer[at + 5]
    return extended + OVERHEAD_BYTES + 2 if MAX_SHORT_BYTES < extended <= MAX_DATA_BYTES else 0


def error_text(message: Message) -> str:
    """Text of an Error message."""
    code = message.data[0] if message.data else 0
    text = f"error 0x{code:02X}: {ERRORS.get(code, 'a code that is in no manual')}"
    return f"{text} ({message.data[1:].hex()})" if len(message.data) > 1 else text


def warning_text(message: Message) -> str:
    """Text of a Warning message: a number, and often a text of its own."""
    if len(message.data) < 4:
        return f"warning {message.data.hex() or 'without content'}"
    (code,) = struct.unpack_from(">I", message.data)
    wording = "".join(chr(byte) for byte in message.data[4:] if 0x20 <= byte < 0x7F).strip()
    return f"warning {code}: {wording or WARNINGS.get(code, 'a code that is in no manual')}"
