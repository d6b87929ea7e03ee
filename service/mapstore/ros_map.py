"""PGM and YAML as ROS map_server reads them."""

import math
import re
from pathlib import Path

import numpy as np
import yaml

from service.errors import InputError
from service.mapstore.picture import FREE_THRESH, OCCUPIED_THRESH, Picture
from service.outputs import FREE, OCCUPIED, UNKNOWN, Grid

_PGM_HEADER = re.compile(rb"P5" + rb"(?:\s|#[^\n]*\n)+(\d{1,9})" * 3 + rb"\s")


def write_ros_map(pgm: Path, yaml_path: Path, picture: Picture) -> None:
    """Write `pgm` and the YAML beside it that names it. Raises OSError."""
    with pgm.open("wb") as file:
        file.write(b"P5\n%d %d\n255\n" % (picture.width, picture.height))
        for band in picture.bands():
            file.write(band.data)
    x, y = _decimal(picture.x_min_m), _decimal(picture.y_min_m)
    yaml_path.write_text(
        f"image: {pgm.name}\nmode: trinary\nresolution: {_decimal(picture.cell_m)}\norigin: [{x}, {y}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n",
        encoding="utf-8",
    )


def read_ros_map(yaml_path: Path) -> Grid:
    """A trinary map, its own or another program's. Raises InputError."""
    try:
        about = yaml.safe_load(yaml_path.read_text(encoding="utf-8"))
        pgm = yaml_path.parent / about["image"]
        cell_m, (x_min_m, y_min_m, yaw_rad) = float(about["resolution"]), map(float, about["origin"])
        occupied, free = float(about["occupied_thresh"]), float(about["free_thresh"])
        negate = bool(about["negate"])
    except OSError as error:
        raise InputError(f"{yaml_path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{yaml_path}: not the YAML of a ROS map: {error!r}") from error
    if not (math.isfinite(cell_m) and cell_m > 0.0) or yaw_rad != 0.0:
        raise InputError(
            f"{yaml_path}: resolution {cell_m} and yaw {yaw_rad}; expected above 0 and exactly 0"
        )
    dark = read_pgm(pgm)[::-1] / np.float32(255)
    share = dark if negate else 1 - dark
    cells = np.full(share.shape, UNKNOWN, dtype=np.int8)
    cells[share > occupied] = OCCUPIED
    cells[share < free] = FREE
    return Grid(0, cell_m, x_min_m, y_min_m, cells)


def read_pgm(path: Path) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    """(H, W) pixels of a binary 8-bit PGM, top row first. Raises InputError."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    header = _PGM_HEADER.match(content)
    if header is None:
        raise InputError(f"{path}: begins with {content[:20]!r}, not with the header of a binary PGM")
    width, height, largest = map(int, header.groups())
    at = header.end()
    if largest != 255 or len(content) - at != width * height:
        raise InputError(
            f"{path}: {width} x {height} pixels up to {largest} in {len(content) - at} bytes; "
            "expected one byte a pixel, up to 255"
        )
    return np.frombuffer(content, dtype=np.uint8, offset=at).reshape(height, width)


def _decimal(value: float) -> str:
    """Never with an exponent, which YAML readers take for text."""
    text = f"{value:.9f}".rstrip("0")
    return text + "0" if text.endswith(".") else text
