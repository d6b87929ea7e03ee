"""8-bit grey PNG, written band by band. Source: W3C PNG specification, second edition, sections 5 and 11."""

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from service.mapstore.picture import Picture

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY_8_BIT = struct.pack(
    ">BBBBB", 8, 0, 0, 0, 0
)  # depth, colour type, compression, filter method, interlace
_LEVEL = 4  # a map is mostly one grey; higher levels take thrice the time for a few per cent


def write_png(path: Path, picture: Picture) -> None:
    """Raises OSError."""
    with path.open("wb") as file:
        file.write(_SIGNATURE)
        _write_chunk(file, b"IHDR", struct.pack(">II", picture.width, picture.height) + _GREY_8_BIT)
        deflate = zlib.compressobj(_LEVEL)
        for band in picture.bands():
            rows = np.zeros(
                (band.shape[0], band.shape[1] + 1), dtype=np.uint8
            )  # each begins with filter type 0
            rows[:, 1:] = band
            if compressed := deflate.compress(rows.data):
                _write_chunk(file, b"IDAT", compressed)
        _write_chunk(file, b"IDAT", deflate.flush())
        _write_chunk(file, b"IEND", b"")


def _write_chunk(file: BinaryIO, kind: bytes, content: bytes) -> None:
    file.write(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    )
