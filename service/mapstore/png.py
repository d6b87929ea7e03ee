"""8-bit PNG, grey or with some colours, written band by band.

Source: W3C PNG specification, second edition, sections 5 and 11.
"""

import struct
import zlib
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np

from service.mapstore.picture import Picture

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _PALETTE = 0, 3  # colour types
_LEVEL = 4  # a map is mostly one grey; higher levels take thrice the time for a few per cent


def write_png(
    path: Path, picture: Picture, colours: Mapping[int, tuple[int, int, int]] | None = None
) -> None:
    """Write pixels as greys, but for values that `colours` gives red, green and blue.

    Raises OSError.
    """
    with path.open("wb") as file:
        _write(file, picture, colours, None)


def png_bytes(picture: Picture, clear: int) -> bytes:
    """As write_png, in memory; pixels of the grey `clear` are transparent."""
    file = BytesIO()
    _write(file, picture, None, clear)
    return file.getvalue()


def _write(
    file: BinaryIO, picture: Picture, colours: Mapping[int, tuple[int, int, int]] | None, clear: int | None
) -> None:
    file.write(_SIGNATURE)
    kind = _GREY if colours is None else _PALETTE
    head = struct.pack(">II", picture.width, picture.height)
    _write_chunk(file, b"IHDR", head + struct.pack(">BBBBB", 8, kind, 0, 0, 0))
    if colours is not None:
        _write_chunk(file, b"PLTE", b"".join(bytes(colours.get(k, (k, k, k))) for k in range(256)))
    if clear is not None:
        _write_chunk(file, b"tRNS", struct.pack(">H", clear))
    deflate = zlib.compressobj(_LEVEL)
    for band in picture.bands():
        # Each row begins with filter type 0.
        rows = np.zeros((band.shape[0], band.shape[1] + 1), dtype=np.uint8)
        rows[:, 1:] = band
        if compressed := deflate.compress(rows.data):
            _write_chunk(file, b"IDAT", compressed)
    _write_chunk(file, b"IDAT", deflate.flush())
    _write_chunk(file, b"IEND", b"")


def _write_chunk(file: BinaryIO, kind: bytes, content: bytes) -> None:
    file.write(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
    )
