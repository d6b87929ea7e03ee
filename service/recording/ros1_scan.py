"""The index of a ROS 1 bag that was never closed or is cut off, made by a walk through its chunks.

Format: http://wiki.ros.org/Bags/Format/2.0. While rosbag writes a chunk, the sizes in its header are 0: after
a crash the last one runs to the end of the file.
"""

import mmap
import struct
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, ChunkInfo, Header, IndexData, ReaderError, RecordType, decompressors

from drivers.counted import counted
from service.limits import MAX_CHUNK_BYTES, TooLargeError
from service.recording.unpacking import decompressor_of, unpacked

_SIZE = struct.Struct("<I")
_MAX_HEADER_BYTES = 1 << 20
Bytes = bytes | mmap.mmap


@dataclass(slots=True)
class Scan:
    """Result of a walk through a bag; losses are counted."""

    connections: dict[int, Connection] = field(default_factory=dict)
    chunks: dict[int, Chunk] = field(default_factory=dict)  # by where they begin
    chunk_infos: list[ChunkInfo] = field(default_factory=list)
    indexes: defaultdict[int, list[IndexData]] = field(default_factory=lambda: defaultdict(list))
    messages: int = 0
    bad_chunks: int = 0
    orphans: int = 0  # messages whose connection was lost
    cut_bytes: int = 0  # at the end of the file

    def __str__(self) -> str:
        found = f"{counted(self.messages, 'message')} of {counted(len(self.chunks), 'chunk')}"
        lost = []
        if self.bad_chunks:
            lost.append(counted(self.bad_chunks, "damaged chunk"))
        if self.orphans:
            lost.append(f"{counted(self.orphans, 'message')} of a topic whose definition is lost")
        if self.cut_bytes:
            lost.append(f"{counted(self.cut_bytes, 'byte')} that are cut off at its end")
        return f"{found} were read without its index; lost: {', '.join(lost) or 'nothing'}"


class ScannedReader(Reader):
    """rosbags' reader, with the index of a scan in the place of the bag's own."""

    def __init__(self, path: Path, scan: Scan) -> None:
        super().__init__(path)
        self._scan = scan

    def open(self) -> None:
        self.bio = self.path.open("rb")
        self.chunks = dict(self._scan.chunks)
        self.chunk_infos = list(self._scan.chunk_infos)
        self.indexes = {conn: sorted(self._scan.indexes[conn]) for conn in self._scan.connections}
        self.connections = [
            connection._replace(msgcount=len(self.indexes[conn]))
            for conn, connection in self._scan.connections.items()
        ]


def scan_bag(path: Path) -> Scan:
    """Raises OSError and ValueError where the file cannot be read at all."""
    scan, reader = Scan(), Reader(path)
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = data.find(b"\n") + 1
        while at < len(data):
            record = _record(data, at)
            if record is None:
                scan.cut_bytes = len(data) - at
                break
            header, begin, end = record
            if header.get("op") == bytes([RecordType.CHUNK]):
                end = _take_chunk(scan, reader, at, header, data, begin, end)
            elif end > len(data):
                scan.cut_bytes = len(data) - at
            at = end
    return scan


def _record(data: Bytes, at: int) -> tuple[Header, int, int] | None:
    """Header, and where the data begins and ends; None where no complete header is there."""
    begin = at + _SIZE.size
    if begin > len(data):
        return None
    (size,) = _SIZE.unpack_from(data, at)
    if size > _MAX_HEADER_BYTES or begin + size + _SIZE.size > len(data):
        return None
    try:
        header = Header.read(BytesIO(data[at : begin + size]))
    except (ReaderError, ValueError):
        return None
    (length,) = _SIZE.unpack_from(data, begin + size)
    begin += size + _SIZE.size
    return header, begin, begin + length


def _take_chunk(
    scan: Scan, reader: Reader, at: int, header: Header, data: Bytes, begin: int, end: int
) -> int:
    """Note what a chunk holds; where the next record begins."""
    compression = header.get("compression", b"").decode(errors="replace")
    if compression not in decompressors:
        scan.bad_chunks += 1
        return end
    is_open = end > len(data) or end == begin
    if is_open:
        end = len(data)
    try:
        content = unpacked_chunk(data[begin:end])
    except TooLargeError:
        raise
    except Exception:  # bad bytes may raise any exception
        scan.bad_chunks += 1
        return end
    used, found, orphans = 0, list[tuple[int, IndexData]](), 0
    try:
        for offset, record, last in _records(content):
            used = last
            conn = record.get_uint32("conn")
            if record.get_uint8("op") == RecordType.CONNECTION:
                if conn not in scan.connections:
                    reader.bio = BytesIO(content[offset:last])
                    scan.connections[conn] = reader.read_connection()
            elif conn not in scan.connections:
                orphans += 1
            else:
                found.append((conn, IndexData(record.get_time("time"), at, offset)))
    except ReaderError:
        scan.bad_chunks += 1
        return end
    if is_open and compression == "none":
        end = begin + used  # what follows are records again, or what is cut off
    elif is_open:
        scan.cut_bytes = len(content) - used if found else end - begin
    scan.messages += len(found)
    scan.orphans += orphans
    if found:
        for conn, entry in found:
            scan.indexes[conn].append(entry)
        times, counts = [entry.time for _, entry in found], Counter(conn for conn, _ in found)
        scan.chunks[at] = Chunk(end - begin, begin, unpacked_chunk)
        scan.chunk_infos.append(ChunkInfo(at, min(times), max(times) + 1, dict(counts)))
    return end


def _records(content: bytes) -> Iterator[tuple[int, Header, int]]:
    """Complete connections and messages at the beginning of a chunk: from where to where."""
    at = 0
    kinds = (bytes([RecordType.CONNECTION]), bytes([RecordType.MSGDATA]))
    while (record := _record(content, at)) is not None:
        header, _, end = record
        if end > len(content) or header.get("op") not in kinds:
            return
        yield at, header, end
        at = end


def unpacked_chunk(data: bytes) -> bytes:
    """The readable part of a chunk, compressed or not. Raises TooLargeError and UnpackError."""
    new = decompressor_of(data)
    return data if new is None else unpacked(data, new, MAX_CHUNK_BYTES, "a chunk")
