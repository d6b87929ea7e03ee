import struct
import zlib

import numpy as np

from service.mapstore.picture import picture_of_tiles
from service.mapstore.png import write_png
from tests.service.mapstore.tile_makers import tile


def read_png(content: bytes) -> np.ndarray:
    """An independent reader of what the standard calls grey, 8 bit, filter 0."""
    assert content.startswith(bytes([137, 80, 78, 71, 13, 10, 26, 10]))
    at, chunks = 8, []
    while at < len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        body = content[at + 8 : at + 8 + length]
        (check,) = struct.unpack_from(">I", content, at + 8 + length)
        assert check == zlib.crc32(kind + body)
        chunks.append((kind, body))
        at += length + 12
    assert [chunks[0][0], chunks[-1][0]] == [b"IHDR", b"IEND"]
    width, height, *kind_of_image = struct.unpack(">IIBBBBB", chunks[0][1])
    assert kind_of_image == [8, 0, 0, 0, 0]
    rows = zlib.decompress(b"".join(body for kind, body in chunks if kind == b"IDAT"))
    rows = np.frombuffer(rows, np.uint8).reshape(height, width + 1)
    assert (rows[:, 0] == 0).all()
    return rows[:, 1:]


def test_a_png_reads_back_pixel_by_pixel(tmp_path):
    picture = picture_of_tiles([tile(x, y, 1 + x + 9 * y) for x in range(9) for y in range(7)])
    write_png(tmp_path / "map.png", picture)
    np.testing.assert_array_equal(
        read_png((tmp_path / "map.png").read_bytes()), np.vstack(list(picture.bands()))
    )


def test_another_program_reads_it_too(tmp_path):
    from PIL import Image

    picture = picture_of_tiles([tile(0, 0, 1), tile(3, 1, 2)])
    write_png(tmp_path / "map.png", picture)
    with Image.open(tmp_path / "map.png") as image:
        assert image.mode == "L"
        np.testing.assert_array_equal(np.asarray(image), np.vstack(list(picture.bands())))
