"""SCIP 2: bytes <-> replies, commands and info lines. No sockets, no clock, no units.

A host sends `command LF`. The device answers `command LF status sum LF [line sum LF ...] LF`, so every reply
ends with an empty line, and a stream of scans is a stream of such replies. Every line but the first carries
the sum of its characters. Source: Hokuyo, Communication Protocol Specification for SCIP 2.0, C-42-03320B.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.device_text import one_line
from drivers.errors import ProtocolError

LF = 0x0A
REPLY_END = b"\n\n"
MAX_REPLY_BYTES = 65_536  # a scan with three echoes and intensities stays below 23 KiB; more is noise
KEPT_BYTES = 32_768  # of an overlong reply: a good one may have begun in it
MAX_COMMAND_BYTES = 256
MAX_SHOWN_BYTES = 80  # of a line in an error
MAX_STRING_CHARS = 16  # a host's own words, repeated in the echo
CLOCK_MODULUS = 1 << 24  # milliseconds; 4 h 39 min 37 s

OK = "00"
SCAN_FOLLOWS = "99"
RESUMED = "98"
ABNORMAL, UNSTABLE, FIRMWARE_UPDATE = "0L", "0M", "0I"
DENIED = "10"
NOT_DEFINED = "0E"
SCIP_1 = "E"

# C-42-03320B and, for 0C to 0M, gbiggs/hokuyoaist and SkoltechRobotics/hokuyolx.
GENERAL_STATUS = {
    "0A": "it cannot build a reply",
    "0B": "buffer shortage, or the command came again while it was worked on",
    "0C": "too few parameters",
    "0D": "not a command it knows, or too long",
    "0E": "not a command it knows",
    "0F": "not supported",
    "0G": "string of more than 16 characters",
    "0H": "invalid characters, or too short",
    "0I": "it waits for new firmware",
    "0L": "abnormal state",
    "0M": "unstable: still warming up?",
    "10": "denied in its present state",
}
SCAN_STATUS = {
    "01": "first step is no number",
    "02": "last step is no number",
    "03": "cluster count is no number",
    "04": "last step out of range",
    "05": "last step below the first",
    "06": "skip is no number",
    "07": "count is no number",
}

_COMMANDS = (
    rb"VV|PP|II|BM|QT|RS|RT|RB|TM\d|%ST|%SL|HS\d|CR\d\d|SS\d{6}|DB\d\d|SCIP2\.0|"
    rb"[GH][DSE]\d{10}|[MN][DSE]\d{13}"
)
_ECHO_AT_END = re.compile(rb"(?:" + _COMMANDS + rb")(?:;[^\n]{0,16})?$")
_STATUS_LINE = re.compile(rb"\n(?:[0-9][0-9A-Z][0-o]|[0E])(?=\n)")
_LONGEST_ECHO = 40


def checksum(line: bytes) -> int:
    """Sum character of a line, without the line feed."""
    return (sum(line) & 0x3F) + 0x30


def encode_number(value: int, chars: int) -> bytes:
    """Six bits a character, highest first, 0x30 added. Raises ValueError where it does not fit."""
    if not 0 <= value < 1 << (6 * chars):
        raise ValueError(f"{value} does not fit into {chars} characters of 6 bits")
    return bytes(((value >> shift) & 0x3F) + 0x30 for shift in range(6 * (chars - 1), -1, -6))


def decode_number(text: bytes) -> int:
    """Raises ProtocolError where a character is none of the code's."""
    value = 0
    for char in text:
        if not 0x30 <= char <= 0x6F:
            raise ProtocolError(f"{text!r} is not coded in six-bit characters")
        value = value << 6 | (char - 0x30)
    return value


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer, or one scan of a stream."""

    echo: str  # the command as the device repeats it, a host's string included
    status: str  # two characters; one from a device in SCIP 1
    body: bytes = b""  # the lines after the status, each with its sum and line feed


class ReplyDecoder:
    """Feed bytes as they come; take replies as they become complete.

    Looks for the last status line of each block, so a reply is found after the rest of another one. What is
    left over is counted. Only echo and status are checked here, lines by who reads them.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._searched = 0
        self.skipped_bytes = 0
        self.unreadable_blocks = 0

    def receive_data(self, data: bytes) -> list[Reply]:
        self._buffer += data
        replies = []
        while (end := self._buffer.find(REPLY_END, self._searched)) >= 0:
            block = bytes(self._buffer[: end + 1])
            del self._buffer[: end + 2]
            self._searched = 0
            if (reply := self._parse(block)) is not None:
                replies.append(reply)
        self._searched = max(0, len(self._buffer) - 1)
        if len(self._buffer) > MAX_REPLY_BYTES:
            cut = len(self._buffer) - KEPT_BYTES
            del self._buffer[:cut]
            self._searched = KEPT_BYTES - 1
            self.skipped_bytes += cut
        return replies

    def _parse(self, block: bytes) -> Reply | None:
        block = block.lstrip(b"\n")
        if not block:
            return None
        for status in reversed(list(_STATUS_LINE.finditer(block))):
            line = status.group()[1:]
            if len(line) == 3 and checksum(line[:2]) != line[2]:
                continue
            line_start = block.rfind(b"\n", 0, status.start()) + 1
            echo = _ECHO_AT_END.search(block, max(line_start, status.start() - _LONGEST_ECHO), status.start())
            if echo is None or not echo.group().isascii():
                continue
            if echo.start():
                self.skipped_bytes += echo.start()
                self.unreadable_blocks += 1
            return Reply(echo.group().decode("ascii"), line[:2].decode("ascii"), block[status.end() + 1 :])
        self.skipped_bytes += len(block)
        self.unreadable_blocks += 1
        return None


def encode_reply(echo: str, status: str, lines: Sequence[bytes] = ()) -> bytes:
    """A complete reply; to each line its sum is added. A status of one character (SCIP 1) has none."""
    code = status.encode("ascii")
    head = echo.encode("ascii") + b"\n" + code + (bytes([checksum(code)]) if len(code) == 2 else b"") + b"\n"
    return head + b"".join(line + bytes([checksum(line), LF]) for line in lines) + b"\n"


def encode_info(echo: str, pairs: Sequence[tuple[str, str]]) -> bytes:
    """Reply of VV, PP and II: lines `KEY:value;` whose sum leaves the semicolon out, as real devices do."""
    texts = [f"{key}:{value}".encode("ascii") for key, value in pairs]
    body = b"".join(text + b";" + bytes([checksum(text), LF]) for text in texts)
    return encode_reply(echo, OK)[:-1] + body + b"\n"


def read_info(reply: Reply) -> dict[str, str]:
    """Keys and values of a VV, PP or II reply, fit to be shown. Raises ProtocolError on a bad sum or a line
    without a key.

    Firmwares differ on whether the sum takes in the semicolon, and a comment that begins with `<-`.
    """
    pairs = {}
    for line in reply.body.split(b"\n")[:-1]:
        text, total, shown = line[:-1], line[-1:], line[:MAX_SHOWN_BYTES]
        bare = text.removesuffix(b";")
        summed = (bare, text, bare.partition(b"<-")[0])
        if not any(total == bytes([checksum(candidate)]) for candidate in summed):
            raise ProtocolError(f"{reply.echo}: line {shown!r} has a wrong sum")
        key, colon, value = bare.partition(b":")
        if not colon or not line.isascii():
            raise ProtocolError(f"{reply.echo}: line {shown!r} is not KEY:value")
        pairs[one_line(key.decode("ascii"))] = one_line(value.decode("ascii"))
    return pairs


def read_time(reply: Reply) -> int:
    """Device clock, ms modulo 2**24, of a TM1 reply. Raises ProtocolError."""
    line = reply.body.removesuffix(b"\n")
    if len(line) != 5 or checksum(line[:4]) != line[4]:
        shown = line[:MAX_SHOWN_BYTES]
        raise ProtocolError(f"{reply.echo}: {shown!r} is not a time of 4 characters and their sum")
    return decode_number(line[:4])


class CommandDecoder:
    """The device's end: feed bytes, take commands, each ended by LF or CR."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def receive_data(self, data: bytes) -> list[str]:
        self._buffer += data.replace(b"\r", b"\n")
        *lines, rest = self._buffer.split(b"\n")
        self._buffer = rest[-MAX_COMMAND_BYTES:]
        return [bytes(line).decode("ascii", "replace") for line in lines if line]
