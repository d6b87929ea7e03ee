"""CoLa telegrams of SICK scanners: bytes <-> typed fields, both dialects, both directions. No I/O, no clock.

CoLa-A is text: STX, fields parted by one blank, ETX. CoLa-B is binary: four STX, 32-bit length, payload, and
one byte, the XOR of the payload; numbers are big-endian and follow each other without blanks.
Source: SICK Telegram Listing 8014631 (framing, number formats, error codes); the value tables agree with
Wireshark's dissector "SICK CoLa A/B".
"""

import re
import struct
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from drivers.errors import ProtocolError

STX, ETX = b"\x02", b"\x03"
HEADER = b"\x02\x02\x02\x02"
MAX_TELEGRAM_BYTES = 32_768  # four channels of 1081 beams are 22 kB in CoLa-A, 9 kB in CoLa-B
MAX_GARBAGE_BYTES = 65_536  # without a valid telegram: this is not a SICK

REFUSALS = {
    0x01: "method access denied: log in with a higher level",
    0x02: "unknown method",
    0x03: "unknown variable",
    0x04: "local condition failed: value not allowed, or not allowed now",
    0x05: "invalid data",
    0x06: "unknown error",
    0x07: "buffer overflow",
    0x08: "too few parameters",
    0x09: "unknown type",
    0x0A: "write access denied: not logged in, or read-only",
    0x0B: "unknown command for the name server",
    0x0C: "unknown CoLa command",
    0x0D: "server busy: one command at a time",
    0x0E: "array index out of bounds",
    0x0F: "unknown event",
    0x10: "value does not fit",
    0x11: "invalid character",
    0x12: "no message from the operating system",
    0x13: "no answer from the operating system",
    0x14: "internal error",
    0x15: "hub address corrupted",
    0x16: "hub address decoding",
    0x17: "hub address exceeded",
    0x18: "hub address: blank expected",
    0x19: "asynchronous methods are suppressed",
    0x1A: "complex arrays are not supported",
}


class Dialect(Enum):
    ASCII = "CoLa-A"
    BINARY = "CoLa-B"


@dataclass(frozen=True, slots=True)
class Telegram:
    """One command, answer or event; `body` is what follows the name and its blank, in the dialect's own form.

    body is None where the blank is missing too: a request without parameters ends with its name, a binary
    answer without values ends with the blank. A refusal (sFA) has no name.
    """

    dialect: Dialect
    kind: str  # sRN sRA sWN sWA sMN sMA sAN sEN sEA sSN sFA
    name: str
    body: bytes | None = None


def refusal_text(telegram: Telegram) -> str:
    """Words for an sFA telegram, e.g. "error 4: local condition failed". Raises ProtocolError."""
    code = reader(telegram).u16()
    return f"error {code:X}: {REFUSALS.get(code, 'not in the telegram listing')}"


def encode(telegram: Telegram) -> bytes:
    """The bytes on the wire."""
    head = telegram.kind.encode("ascii")
    if telegram.name:
        head += b" " + telegram.name.encode("ascii")
    if telegram.body is None:
        payload = head
    elif telegram.kind == "sFA" and telegram.dialect is Dialect.BINARY:
        payload = head + telegram.body
    else:
        payload = head + b" " + telegram.body
    if telegram.dialect is Dialect.ASCII:
        return STX + payload + ETX
    return HEADER + struct.pack(">I", len(payload)) + payload + bytes([_xor(payload)])


class Decoder:
    """Feed bytes as they come; take telegrams as they become complete.

    With dialect None either is understood, telegram by telegram; set `dialect` once the device has shown its
    own, then a binary stream joined in its middle is never taken for text. Garbage is skipped and counted.
    """

    def __init__(self, dialect: Dialect | None = None) -> None:
        self.dialect = dialect
        self.skipped_bytes = 0
        self.bad_checksums = 0
        self._buffer = bytearray()
        self._garbage_bytes = 0  # since the last good telegram

    def receive_data(self, data: bytes) -> list[Telegram]:
        """Raises ProtocolError after 64 KiB without a single telegram."""
        self._buffer += data
        telegrams = []
        while (telegram := self._next_telegram()) is not None:
            telegrams.append(telegram)
        if telegrams:
            self._garbage_bytes = 0
        elif self._garbage_bytes > MAX_GARBAGE_BYTES:
            raise ProtocolError(
                f"{self._garbage_bytes} bytes without a CoLa telegram (limit {MAX_GARBAGE_BYTES}); "
                "is this the host port (2111 or 2112) of a SICK scanner?"
            )
        return telegrams

    def _next_telegram(self) -> Telegram | None:
        buffer = self._buffer
        while True:
            start = buffer.find(STX)
            self._skip(len(buffer) if start < 0 else start)
            if len(buffer) < 2:
                return None
            if self.dialect is Dialect.BINARY or (self.dialect is None and buffer[1] == STX[0]):
                is_complete, telegram = self._binary_telegram()
            else:
                is_complete, telegram = self._ascii_telegram()
            if not is_complete:
                return None
            if telegram is not None:
                return telegram

    def _ascii_telegram(self) -> tuple[bool, Telegram | None]:
        """(False, None): more bytes are needed. (True, None): garbage was skipped, look again."""
        buffer = self._buffer
        end = buffer.find(ETX)
        restart = buffer.find(STX, 1, end if end >= 0 else len(buffer))  # STX cannot stand inside
        if restart >= 0 or buffer[1] != ord("s"):
            self._skip(max(restart, 1))
            return True, None
        if end < 0:
            if len(buffer) <= MAX_TELEGRAM_BYTES:
                return False, None
            self._skip(len(buffer))
            return True, None
        telegram = _parse(bytes(buffer[1:end]), Dialect.ASCII)
        if telegram is None:
            self._skip(end + 1)
        else:
            del buffer[: end + 1]
        return True, telegram

    def _binary_telegram(self) -> tuple[bool, Telegram | None]:
        buffer = self._buffer
        length = _binary_length(buffer, 0)
        if length is None:
            self._skip(1)
            return True, None
        if length == 0 or len(buffer) < length + 9:
            if (start := self._complete_binary_telegram_behind()) > 0:
                self._skip(start)
                return True, None
            return False, None
        payload = bytes(buffer[8 : 8 + length])
        if _xor(payload) != buffer[8 + length]:
            self.bad_checksums += 1
            self._skip(1)
            return True, None
        telegram = _parse(payload, Dialect.BINARY)
        if telegram is None:
            self._skip(length + 9)
        else:
            del buffer[: length + 9]
        return True, telegram

    def _complete_binary_telegram_behind(self) -> int:
        """Where one starts behind a header whose own telegram is not complete yet; -1: nowhere.

        Without this a damaged length would discard the good telegrams that follow it.
        """
        buffer = self._buffer
        start = buffer.find(HEADER, 4)
        while start > 0:
            length = _binary_length(buffer, start)
            if length and len(buffer) >= start + length + 9:
                payload = bytes(buffer[start + 8 : start + 8 + length])
                if _xor(payload) == buffer[start + 8 + length]:
                    return start
            start = buffer.find(HEADER, start + 1)
        return -1

    def _skip(self, count: int) -> None:
        if count:
            self.skipped_bytes += count
            self._garbage_bytes += count
            del self._buffer[:count]


def _binary_length(buffer: bytearray, start: int) -> int | None:
    """Payload length at a possible header; 0: not enough bytes to tell; None: no header."""
    head = buffer[start : start + 9]
    if head[:4] != HEADER[: len(head)]:
        return None
    if len(head) < 9:
        return 0
    length = int.from_bytes(head[4:8], "big")
    return length if 3 <= length <= MAX_TELEGRAM_BYTES and head[8] == ord("s") else None


def _xor(payload: bytes) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(payload, dtype=np.uint8)))


_HEAD = re.compile(rb"(s[A-Z]{2}) ([A-Za-z0-9_]+)(?: (.*))?", re.DOTALL)


def _parse(payload: bytes, dialect: Dialect) -> Telegram | None:
    if payload[:3] == b"sFA":
        body = payload[4:] if dialect is Dialect.ASCII else payload[3:]
        return Telegram(dialect, "sFA", "", body)
    match = _HEAD.fullmatch(payload)
    if match is None:
        return None
    kind, name, body = match.groups()
    return Telegram(dialect, kind.decode("ascii"), name.decode("ascii"), body)


class _Body:
    """Of a telegram, read from its start."""

    def __init__(self, body: bytes) -> None:
        self._body = body
        self._at = 0

    @property
    def at_end(self) -> bool:
        return self._at >= len(self._body)


class BinaryReader(_Body):
    """Takes fields off a CoLa-B body. Every method raises ProtocolError where the body ends too early."""

    def _take(self, count: int) -> bytes:
        taken = self._body[self._at : self._at + count]
        if len(taken) < count:
            raise ProtocolError(
                f"body of {counted(len(self._body), 'byte')} ends inside the "
                f"{counted(count, 'byte')} from {self._at}"
            )
        self._at += count
        return taken

    def u8(self) -> int:
        return self._take(1)[0]

    def u16(self) -> int:
        return int.from_bytes(self._take(2), "big")

    def u32(self) -> int:
        return int.from_bytes(self._take(4), "big")

    def i32(self) -> int:
        return int.from_bytes(self._take(4), "big", signed=True)

    def f32(self) -> float:
        return float(struct.unpack(">f", self._take(4))[0])

    def characters(self, count: int) -> str:
        """Text of fixed length."""
        return self._take(count).decode("latin-1")

    def text(self) -> str:
        """Text behind its own length."""
        return self.characters(self.u16())

    def array(self, count: int, bits: int) -> npt.NDArray[np.uint16]:
        """(count,) unsigned numbers of 8 or 16 bits."""
        dtype = ">u2" if bits == 16 else np.uint8
        return np.frombuffer(self._take(count * bits // 8), dtype=dtype).astype(np.uint16)


_NO_DIGIT = 0x8000
_DIGITS = np.full(256, _NO_DIGIT, dtype=np.uint16)
_DIGITS[ord(" ")] = 0
for _value, _digit in enumerate(b"0123456789ABCDEF"):
    _DIGITS[_digit] = _value
for _value, _digit in enumerate(b"abcdef", start=10):
    _DIGITS[_digit] = _value


class AsciiReader(_Body):
    """Takes fields off a CoLa-A body. Hexadecimal, or decimal where a sign stands in front."""

    def _token(self) -> bytes:
        end = self._body.find(b" ", self._at)
        if end < 0:
            end = len(self._body)
        token = self._body[self._at : end]
        if not token:
            raise ProtocolError(f"no field at byte {self._at} of {self._body[:40]!r}")
        self._at = end + 1
        return token

    def _number(self, bits: int) -> int:
        token = self._token()
        try:
            value = int(token) if token[0] in b"+-" else int(token, 16)
        except ValueError:
            raise ProtocolError(f"{token[:20]!r} is not a number of {bits} bits") from None
        if not -(1 << (bits - 1)) <= value < 1 << bits:
            raise ProtocolError(f"{token[:20]!r} does not fit {bits} bits")
        return value

    def _unsigned(self, bits: int) -> int:
        value = self._number(bits)
        if value < 0:
            raise ProtocolError(f"{value} where an unsigned number of {bits} bits stands")
        return value

    def u8(self) -> int:
        return self._unsigned(8)

    def u16(self) -> int:
        return self._unsigned(16)

    def u32(self) -> int:
        return self._unsigned(32)

    def i32(self) -> int:
        value = self._number(32)
        return value - (1 << 32) if value >= 1 << 31 else value

    def f32(self) -> float:
        return float(struct.unpack(">f", struct.pack(">I", self._unsigned(32)))[0])

    def characters(self, count: int) -> str:
        text = self._body[self._at : self._at + count]
        if len(text) < count:
            raise ProtocolError(f"text of {counted(count, 'character')} ends after {len(text)}")
        self._at += count + 1
        return text.decode("latin-1")

    def text(self) -> str:
        count = self.u16()
        if count:
            return self.characters(count)
        self._at += self._body[self._at : self._at + 1] == b" "  # some write the blank of an empty text
        return ""

    def array(self, count: int, bits: int) -> npt.NDArray[np.uint16]:
        """(count,) unsigned numbers of 8 or 16 bits, all digits at once."""
        most = bits // 4
        codes = np.frombuffer(self._body, dtype=np.uint8)[self._at : self._at + (most + 1) * count]
        ends = np.flatnonzero(codes == ord(" "))[:count]
        if len(ends) < count:  # the last number of a body has no blank behind it
            ends = np.append(ends, len(codes))
        lengths = np.diff(ends, prepend=-1) - 1
        if len(ends) != count or (count and not 1 <= lengths.min() <= lengths.max() <= most):
            raise ProtocolError(
                f"no {counted(count, 'number')} of {bits} bits at byte {self._at} of {len(self._body)}"
            )
        if not count:
            return np.zeros(0, dtype=np.uint16)
        digits = _DIGITS[codes[: ends[-1]]]
        if digits.max() == _NO_DIGIT:
            raise ProtocolError(f"a character that is no hexadecimal digit in {counted(count, 'number')}")
        values = digits[ends - 1]
        for place in range(1, int(lengths.max())):
            values += (digits[ends - 1 - place] << (4 * place)) * (lengths > place)
        self._at += int(ends[-1]) + 1
        return values


Reader = AsciiReader | BinaryReader


def reader(telegram: Telegram) -> Reader:
    """Reads the telegram's body from its start; a missing body reads as empty."""
    body = telegram.body or b""
    return AsciiReader(body) if telegram.dialect is Dialect.ASCII else BinaryReader(body)


class BinaryWriter:
    """Puts fields into a CoLa-B body. A number that does not fit raises struct.error."""

    def __init__(self) -> None:
        self.body = b""

    def u8(self, *values: int) -> None:
        self.body += struct.pack(f">{len(values)}B", *values)

    def u16(self, *values: int) -> None:
        self.body += struct.pack(f">{len(values)}H", *values)

    def u32(self, *values: int) -> None:
        self.body += struct.pack(f">{len(values)}I", *values)

    def i32(self, *values: int) -> None:
        self.body += struct.pack(f">{len(values)}i", *values)

    def f32(self, *values: float) -> None:
        self.body += struct.pack(f">{len(values)}f", *values)

    def characters(self, text: str) -> None:
        self.body += text.encode("latin-1")

    def text(self, text: str) -> None:
        self.u16(len(text))
        self.characters(text)

    def array(self, values: npt.NDArray[np.uint16], bits: int) -> None:
        self.body += values.astype(">u2" if bits == 16 else np.uint8).tobytes()


class AsciiWriter:
    """Puts fields into a CoLa-A body: upper-case hexadecimal without leading zeros, floats in 8 digits."""

    def __init__(self) -> None:
        self._tokens: list[bytes] = []

    @property
    def body(self) -> bytes:
        return b" ".join(self._tokens)

    def u8(self, *values: int) -> None:
        self._tokens += [b"%X" % value for value in values]

    u16 = u32 = u8  # no number has a width

    def i32(self, *values: int) -> None:
        self.u32(*(value & 0xFFFF_FFFF for value in values))

    def f32(self, *values: float) -> None:
        self._tokens += [struct.pack(">f", value).hex().upper().encode("ascii") for value in values]

    def characters(self, text: str) -> None:
        self._tokens.append(text.encode("latin-1"))

    def text(self, text: str) -> None:
        self.u16(len(text))
        if text:
            self.characters(text)

    def array(self, values: npt.NDArray[np.uint16], bits: int) -> None:
        if len(values):
            self._tokens.append(b" ".join([b"%X" % value for value in values.tolist()]))


Writer = AsciiWriter | BinaryWriter


def writer(dialect: Dialect) -> Writer:
    """An empty body in this dialect."""
    return AsciiWriter() if dialect is Dialect.ASCII else BinaryWriter()
