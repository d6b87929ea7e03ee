"""Chunks of an MCAP file, unpacked within limits: a few bytes may claim, and become, any size.

The library's own `breakup_chunk` believes the sizes.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader

from service.limits import MAX_CHUNK_BYTES, MAX_CHUNK_RECORDS, Unpacking, check, factor

ChunkRecord = Schema | Channel | Message

_FRAME = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class ChunkError(ValueError):
    """A chunk differs from its header."""


def all_records(stream: BinaryIO, unpacking: Unpacking, what: object) -> Iterator[McapRecord]:
    """From the stream's place to its end, those in chunks one by one. Raises as the library does, ChunkError
    and TooLargeError; `what` names the file.
    """
    limit = round(MAX_CHUNK_BYTES * factor())
    for record in StreamReader(stream, emit_chunks=True, record_size_limit=limit).records:
        if isinstance(record, Chunk):
            yield from chunk_records(record, unpacking, what)
        else:
            yield record


def chunk_records(chunk: Chunk, unpacking: Unpacking, what: object) -> list[ChunkRecord]:
    """Raises ChunkError and what the decompressors raise, TooLargeError beyond a limit."""
    content = _content(chunk, unpacking, what)
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise ChunkError("the checksum of a chunk does not fit")
    records, used = complete_records(content, what)
    if used < len(content):
        raise ChunkError(f"a chunk holds no whole record at byte {used} of {len(content)}")
    return records


def complete_records(content: bytes, what: object) -> tuple[list[ChunkRecord], int]:
    """Complete records at the beginning of a chunk's content, and their bytes. Raises TooLargeError."""
    records: list[ChunkRecord] = []
    at = others = 0
    while at + _FRAME.size <= len(content):
        opcode, length = _FRAME.unpack_from(content, at)
        begin, end = at + _FRAME.size, at + _FRAME.size + length
        if opcode == 0 or end > len(content):
            break
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                break
            channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content, begin)
            payload = content[begin + _MESSAGE.size : end]
            records.append(Message(channel, log_ns, payload, publish_ns, sequence))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            kind = Schema if opcode == Opcode.SCHEMA else Channel
            records.append(kind.read(ReadDataStream(BytesIO(content[begin:end]))))
        else:
            others += 1  # of a later version of MCAP
        at = end
        check(len(records) + others, MAX_CHUNK_RECORDS, f"{what}: a chunk", "records")
    return records, at


def _content(chunk: Chunk, unpacking: Unpacking, what: object) -> bytes:
    """The size is known, and within the limits, before anything is unpacked."""
    size, packed = chunk.uncompressed_size, chunk.data
    check(size, MAX_CHUNK_BYTES, f"{what}: a chunk, unpacked")
    unpacking.take(size)
    match chunk.compression:
        case "zstd":
            claimed = zstandard.frame_content_size(packed)  # -1: not stated in the frame
            if claimed not in (-1, size):
                raise ChunkError(f"a chunk of {size} bytes claims to be one of {claimed} inside")
            content = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size) if size else b""
        case "lz4":
            content = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
        case "":
            content = packed
        case other:
            raise ChunkError(f"a chunk is compressed by {other!r}; expected zstd, lz4 or nothing")
    if len(content) != size:
        raise ChunkError(f"a chunk unpacks to {len(content)} bytes, its header says {size}")
    return content
