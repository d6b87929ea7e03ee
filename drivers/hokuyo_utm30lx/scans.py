"""Scans on the wire: requests for them and the coded values, in both directions. No I/O, no units but the
device's own.

Values stand as 2 (GS, MS) or 3 characters, intensity behind each range (GE, ME), further echoes of a beam
behind an ampersand (HD, HE, ND, NE), cut into lines of 64 characters without regard to value borders.
Source: Hokuyo, Communication Protocol Specification for SCIP 2.0, C-42-03320B; UrgNetwork/urg_library.
"""

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.counted import counted
from drivers.errors import ProtocolError
from drivers.hokuyo_utm30lx.protocol import LF, SCAN_FOLLOWS, Reply, checksum, decode_number, encode_number

NO_ECHO = -1  # in a row of Scan: the beam has fewer echoes
MAX_ECHOES = 3
LINE_CHARS = 64
STAMP_CHARS = 4
LARGEST = {2: (1 << 12) - 1, 3: (1 << 18) - 1}  # by characters a value
AMPERSAND = 0x26
_REQUEST = re.compile(r"([GH][DSE])(\d{4})(\d{4})(\d\d)|([MN][DSE])(\d{4})(\d{4})(\d\d)(\d)(\d\d)")

Ints = npt.NDArray[np.int32]
Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """G and H request one scan, M and N for a stream; D for ranges, S for short ones, E for intensities too;
    H and N for all echoes.
    """

    command: str
    first_step: int
    last_step: int
    cluster: int = 1  # of so many neighbours the nearest is sent; 0 is 1
    skip: int = 0  # scans left out between two; streams only
    count: int = 0  # scans, 0 for no end; in a stream's scans: how many remain; streams only

    @property
    def streams(self) -> bool:
        return self.command[0] in "MN"

    @property
    def multi_echo(self) -> bool:
        return self.command[0] in "HN"

    @property
    def with_intensity(self) -> bool:
        return self.command[1] == "E"

    @property
    def value_chars(self) -> int:
        return 2 if self.command[1] == "S" else 3

    @property
    def beam_count(self) -> int:
        return -(-(self.last_step - self.first_step + 1) // max(self.cluster, 1))

    @property
    def text(self) -> str:
        text = f"{self.command}{self.first_step:04}{self.last_step:04}{self.cluster:02}"
        return f"{text}{self.skip}{self.count:02}" if self.streams else text


def read_request(echo: str) -> ScanRequest:
    """Raises ProtocolError where the text is no request for scans."""
    match = _REQUEST.fullmatch(echo.partition(";")[0])
    if match is None:
        raise ProtocolError(f"{echo!r} is no request for scans")
    command, *numbers = (group for group in match.groups() if group is not None)
    request = ScanRequest(command, *(int(number) for number in numbers))
    if request.last_step < request.first_step:
        raise ProtocolError(f"{echo!r} ends before it begins")
    return request


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep as coded. Row e holds echo e + 1 of every beam, NO_ECHO where it has fewer."""

    request: ScanRequest
    stamp_ms: int  # device clock, modulo 2**24
    distance_mm: Ints  # (E, N), E from 1 to 3; small values are error codes
    intensity: Ints  # (E, N), or (0, N) where not requested


def read_scan(reply: Reply) -> Scan:
    """Raises ProtocolError where a sum, a character or the number of values is wrong."""
    request = read_request(reply.echo)
    stamp_end = reply.body.find(b"\n")
    stamp = reply.body[:stamp_end]
    if len(stamp) != STAMP_CHARS + 1 or checksum(stamp[:-1]) != stamp[-1]:
        raise ProtocolError(f"{reply.echo}: {stamp[:16]!r} is not a stamp of 4 characters and their sum")
    payload = _without_sums(reply, stamp_end + 1)
    chars = request.value_chars * (2 if request.with_intensity else 1)
    echo_rows = None
    if request.multi_echo:
        payload, echo_rows = _without_ampersands(reply, payload, chars)
    if payload.size and (payload.min() < 0x30 or payload.max() > 0x6F):
        raise ProtocolError(f"{reply.echo}: characters outside of the six-bit code")
    if payload.size % chars:
        raise ProtocolError(f"{reply.echo}: {counted(payload.size, 'character')}: no whole number of values")
    values = _values(payload, request.value_chars)
    if request.with_intensity:
        values = values.reshape(-1, 2)
    columns = values.reshape(-1, 2 if request.with_intensity else 1).T
    rows = columns[:, np.newaxis, :] if echo_rows is None else _by_echo(columns, echo_rows)
    beam_count = rows.shape[-1]
    if beam_count != request.beam_count:
        raise ProtocolError(f"{reply.echo}: {counted(beam_count, 'beam')}, expected {request.beam_count}")
    distance_mm = rows[0]
    intensity = rows[1] if request.with_intensity else distance_mm[:0]
    return Scan(request, decode_number(stamp[:-1]), distance_mm, intensity)


def _without_sums(reply: Reply, start: int) -> Bytes:
    """(C,) characters of all data lines, their sums checked and taken out."""
    body = np.frombuffer(reply.body, dtype=np.uint8, offset=start)
    ends = np.flatnonzero(body == LF)
    if not ends.size or ends[-1] != body.size - 1:
        raise ProtocolError(f"{reply.echo}: no values")
    starts = np.empty_like(ends)
    starts[0], starts[1:] = 0, ends[:-1] + 1
    lengths = ends - starts
    if lengths.min() < 2 or lengths.max() > LINE_CHARS + 1:
        raise ProtocolError(f"{reply.echo}: a line of {lengths.max()} characters, expected 65 or fewer")
    total = np.cumsum(body, dtype=np.int32)
    sums = total[ends - 2]
    sums[1:] -= total[ends[:-1]]
    wrong = np.flatnonzero((sums & 0x3F) + 0x30 != body[ends - 1])
    if wrong.size:
        raise ProtocolError(f"{reply.echo}: line {wrong[0] + 1} of {ends.size} has a wrong sum")
    keep = np.ones(body.size, dtype=np.bool_)
    keep[ends] = False
    keep[ends - 1] = False
    return body[keep]


def _without_ampersands(reply: Reply, payload: Bytes, chars: int) -> tuple[Bytes, Ints]:
    """(C,) characters without the ampersands, and (V,) which echo of its beam each value is, from 0."""
    ampersand = payload == AMPERSAND
    places = np.flatnonzero(ampersand)
    before = places - np.arange(places.size)
    further, split = np.divmod(before, chars)
    value_count = (payload.size - places.size) // chars
    is_further = np.zeros(value_count + 1, dtype=np.bool_)
    is_further[np.minimum(further, value_count)] = True
    doubled = np.count_nonzero(is_further) != places.size
    if split.any() or is_further[0] or is_further[value_count] or doubled:
        raise ProtocolError(f"{reply.echo}: an ampersand where no further echo can begin")
    index = np.arange(value_count, dtype=np.int32)
    first = np.where(is_further[:-1], 0, index)
    return payload[~ampersand], index - np.maximum.accumulate(first)


def _values(payload: Bytes, chars: int) -> Ints:
    digits = (payload - np.uint8(0x30)).reshape(-1, chars).astype(np.int32)
    values = digits[:, 0]
    for column in range(1, chars):
        values = (values << 6) | digits[:, column]
    return values


def _by_echo(columns: Ints, echo_rows: Ints) -> Ints:
    """(C, V) values in the order sent -> (C, E, N). Raises ProtocolError on a fourth echo."""
    echoes = int(echo_rows.max()) + 1 if echo_rows.size else 1
    if echoes > MAX_ECHOES:
        raise ProtocolError(f"a beam with {echoes} echoes, at most {MAX_ECHOES} are possible")
    beam = np.cumsum(echo_rows == 0) - 1
    rows = np.full((columns.shape[0], echoes, int(beam[-1]) + 1 if beam.size else 0), NO_ECHO, dtype=np.int32)
    rows[:, echo_rows, beam] = columns
    return rows


def write_scan(scan: Scan, echo: str = "", status: str = SCAN_FOLLOWS) -> bytes:
    """The reply that carries a scan; `echo` where it differs from the request's text, by a host's string."""
    request = scan.request
    largest = LARGEST[request.value_chars]
    columns = np.stack([scan.distance_mm, scan.intensity] if request.with_intensity else [scan.distance_mm])
    there = scan.distance_mm.T != NO_ECHO  # (N, E)
    values = np.minimum(columns, largest).transpose(2, 1, 0)[there]  # (V, C)
    shifts = np.arange(6 * (request.value_chars - 1), -1, -6)
    digits = (((values[..., np.newaxis] >> shifts) & 0x3F) + 0x30).astype(np.uint8).reshape(len(values), -1)
    further = np.broadcast_to(np.arange(there.shape[1]) > 0, there.shape)[there]
    text = np.column_stack([np.full(len(digits), AMPERSAND, dtype=np.uint8), digits])
    keep = np.ones(text.shape, dtype=np.bool_)
    keep[:, 0] = further
    stamp = encode_number(scan.stamp_ms, STAMP_CHARS)
    head = (echo or request.text).encode("ascii") + b"\n"
    code = status.encode("ascii")
    head += b"".join(line + bytes([checksum(line), LF]) for line in (code, stamp))
    return head + _in_lines(text[keep]) + b"\n"


def _in_lines(payload: Bytes) -> bytes:
    """Cut into lines of 64, each with its sum."""
    full_lines = payload.size // LINE_CHARS
    lines = np.empty((full_lines, LINE_CHARS + 2), dtype=np.uint8)
    lines[:, :LINE_CHARS] = payload[: full_lines * LINE_CHARS].reshape(full_lines, LINE_CHARS)
    lines[:, LINE_CHARS] = (lines[:, :LINE_CHARS].sum(axis=1, dtype=np.int64) & 0x3F) + 0x30
    lines[:, LINE_CHARS + 1] = LF
    rest = payload[full_lines * LINE_CHARS :].tobytes()
    return lines.tobytes() + (rest + bytes([checksum(rest), LF]) if rest else b"")
