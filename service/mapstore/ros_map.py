"""Maps as files of ROS map_server: a picture, and YAML beside it."""

import logging
import math
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import yaml

from service.errors import InputError, words_of
from service.limits import MAX_IMAGE_BYTES, MAX_YAML_BYTES, Unpacking, check
from service.mapstore.picture import FREE_THRESH, MAX_PIXELS, OCCUPIED_THRESH, Picture
from service.outputs import FREE, OCCUPIED, UNKNOWN, Grid
from service.readable import open_file, read_text

if TYPE_CHECKING:
    from PIL.Image import Image

log = logging.getLogger(__name__)

Floats = npt.NDArray[np.float64]
Cells = npt.NDArray[np.int8]

MODES = ("trinary", "scale", "raw")
FORMATS = ("PPM", "PNG", "BMP")  # of Pillow; the first reads PGM, too
BAND_ROWS = 512  # that are made cells of at a time
BYTES_A_PIXEL = {"1": 1, "L": 1, "P": 1, "LA": 4, "I;16": 2, "I;16B": 2}  # in memory; of others 4
ROUNDING = 0.01  # of a cell: a right angle is written as 1.5708


def write_ros_map(pgm: Path, yaml_path: Path, picture: Picture) -> None:
    """Write `pgm` and the YAML beside it that names it. Raises OSError."""
    with pgm.open("wb") as file:
        file.write(b"P5\n%d %d\n255\n" % (picture.width, picture.height))
        for band in picture.bands():
            file.write(band.data)
    x, y = _decimal(picture.x_min_m), _decimal(picture.y_min_m)
    image = yaml.safe_dump({"image": pgm.name}, allow_unicode=True, width=math.inf)  # quoted where it must be
    yaml_path.write_text(
        f"{image}mode: trinary\nresolution: {_decimal(picture.cell_m)}\norigin: [{x}, {y}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n",
        encoding="utf-8",
    )


def read_ros_map(yaml_path: Path) -> Grid:
    """A map as map_server of nav2 reads it, along the axes of the map frame. Raises InputError.

    Source: nav2_map_server, map_io.cpp, releases Humble to Jazzy. A map whose origin has a yaw, which
    map_server leaves to its subscribers, is resampled here, with a warning.
    """
    try:
        about = yaml.safe_load(read_text(yaml_path, limit=MAX_YAML_BYTES))
        image_path = yaml_path.parent / about["image"]
        cell_m, (x_min_m, y_min_m, yaw_rad) = float(about["resolution"]), map(float, about["origin"])
        rule = _Rule(
            about.get("mode", "trinary"),
            int(about["negate"]) != 0,
            float(about["occupied_thresh"]),
            float(about["free_thresh"]),
        )
    except OSError as error:
        raise InputError(f"{yaml_path}: {error.strerror}") from error
    except (yaml.YAMLError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError(f"{yaml_path}: not the YAML of a ROS map: {repr(error)[:300]}") from error
    except RecursionError as error:
        raise InputError(f"{yaml_path}: not the YAML of a ROS map: nested too deep") from error
    if not (all(map(math.isfinite, (cell_m, x_min_m, y_min_m, yaw_rad))) and cell_m > 0.0):
        raise InputError(
            f"{yaml_path}: resolution {cell_m} m and origin [{x_min_m}, {y_min_m}, {yaw_rad}]; "
            "expected finite numbers and a resolution above 0"
        )
    if problem := rule.problem():
        raise InputError(f"{yaml_path}: {problem}")
    grid = Grid(0, cell_m, x_min_m, y_min_m, _read_cells(image_path, rule)[::-1])
    if yaw_rad == 0.0:
        return grid
    log.warning(
        "%s: its origin has a yaw of %.3f deg; each cell of the map is that of the file which lies nearest, "
        "so walls move by up to %.3f m",
        *(yaml_path, math.degrees(yaw_rad), cell_m / math.sqrt(2.0)),
    )
    try:
        return _turned(grid, yaw_rad)
    except ValueError as error:
        raise InputError(f"{yaml_path}: {error}") from error


@dataclass(frozen=True, slots=True)
class _Rule:
    """How a pixel becomes a cell."""

    mode: str
    is_negated: bool
    occupied_thresh: float
    free_thresh: float

    def problem(self) -> str:
        """What map_server could not read by; "" where all is well."""
        if not isinstance(self.mode, str) or self.mode not in MODES:
            return f"mode {str(self.mode)[:60]}; expected {', '.join(MODES)}"
        if not (math.isfinite(self.occupied_thresh) and math.isfinite(self.free_thresh)):
            return f"thresholds {self.free_thresh} and {self.occupied_thresh}; expected finite numbers"
        if self.mode == "scale" and not self.free_thresh < self.occupied_thresh:
            return (
                f"free_thresh {self.free_thresh} and occupied_thresh {self.occupied_thresh}; "
                "mode scale needs the first below the second"
            )
        return ""

    def occupancy(self, shade: Floats, opacity: Floats | None) -> Cells:
        """(H, W) cells by shade, 0 black to 1 white, and opacity, 0 to 1, of each pixel; None: all are 1."""
        cells = np.full(shade.shape, UNKNOWN, dtype=np.int8)
        if self.mode == "raw":  # the value itself, by neither threshold nor negate
            value = np.floor(shade * 255.0 + 0.5)
            is_known = value <= OCCUPIED
            cells[is_known] = value[is_known]
            return cells
        if self.mode == "trinary" and opacity is not None:
            shade = (3.0 * shade + opacity) / 4.0  # one more channel beside red, green and blue
        share = shade if self.is_negated else 1.0 - shade
        if self.mode == "scale":
            span = self.occupied_thresh - self.free_thresh
            within = (share >= self.free_thresh) & (share <= self.occupied_thresh)
            cells[within] = np.rint((share[within] - self.free_thresh) / span * 100.0)
        cells[share < self.free_thresh] = FREE
        cells[share > self.occupied_thresh] = OCCUPIED
        if self.mode == "scale" and opacity is not None:
            cells[opacity < 1.0] = UNKNOWN
        return cells


def _read_cells(path: Path, rule: _Rule) -> Cells:
    """(H, W) of a PGM, PNG or BMP, top row first. Raises InputError."""
    from PIL import Image  # takes 0.1 s, and only what reads such a map needs it

    Image.MAX_IMAGE_PIXELS = None  # its own limit is for photographs
    try:
        with open_file(path) as file, Image.open(file, formats=FORMATS) as image:
            size = image.width * image.height * BYTES_A_PIXEL.get(image.mode, 4)
            check(size, MAX_IMAGE_BYTES, f"{path}: {image.width} x {image.height} pixels, unpacked")
            Unpacking(path, os.fstat(file.fileno()).st_size).take(size)
            cells = np.empty((image.height, image.width), dtype=np.int8)
            for top in range(0, image.height, BAND_ROWS):
                band = image.crop((0, top, image.width, min(top + BAND_ROWS, image.height)))
                cells[top : top + BAND_ROWS] = rule.occupancy(*_shades(band))
            return cells
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error) as error:
        raise InputError(f"{path}: no PGM, PNG or BMP that can be read: {words_of(error)}") from error


def _shades(image: "Image") -> tuple[Floats, Floats | None]:
    """(H, W) mean of red, green and blue, 0 black to 1 white, and opacity of each pixel; None: all are 1."""
    if image.mode.startswith("I"):  # 16 bit grey, which Pillow's conversions cut at 255
        levels = np.asarray(image, dtype=np.float64)
        see_through = image.info.get("transparency")
        return levels / 65535.0, None if see_through is None else (levels != see_through).astype(np.float64)
    has_opacity = image.has_transparency_data
    channels = np.asarray(image.convert("RGBA" if has_opacity else "RGB"), dtype=np.float64) / 255.0
    return channels[..., :3].mean(axis=2), channels[..., 3] if has_opacity else None


def _turned(grid: Grid, yaw_rad: float) -> Grid:
    """A grid turned by `yaw_rad` about its lower left corner, as one along the axes: each cell is the one of
    the given grid in which its middle lies, unknown outside of it. Raises ValueError beyond MAX_PIXELS.
    """
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    height, width = grid.cells.shape
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)]) @ np.array([[c, s], [-s, c]])
    low, high = corners.min(axis=0), corners.max(axis=0)
    columns, rows = np.ceil(high - low - ROUNDING).astype(int)  # cells
    if columns * rows > MAX_PIXELS:
        raise ValueError(f"{columns} x {rows} cells when the map is turned; at most {MAX_PIXELS} are read")
    x, y = low[0] + np.arange(columns) + 0.5, low[1] + np.arange(rows)[:, None] + 0.5
    column, row = np.floor(c * x + s * y).astype(int), np.floor(c * y - s * x).astype(int)
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    cells = np.full((rows, columns), UNKNOWN, dtype=np.int8)
    cells[is_inside] = grid.cells[row[is_inside], column[is_inside]]
    x_min_m, y_min_m = (grid.x_min_m, grid.y_min_m) + low * grid.cell_m
    return Grid(grid.version, grid.cell_m, float(x_min_m), float(y_min_m), cells)


def _decimal(value: float) -> str:
    """Never with an exponent, which YAML readers take for text."""
    text = f"{value:.9f}".rstrip("0")
    return text + "0" if text.endswith(".") else text
