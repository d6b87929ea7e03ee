"""The map as grey pixels in bands from the top, so that no file needs the complete map in memory at once."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.errors import StorageError
from service.outputs import Grid, TileUpdate

Pixels = npt.NDArray[np.uint8]

BLACK_OCCUPIED, WHITE_FREE, GREY_UNKNOWN = 0, 254, 205  # as ROS map_server writes them
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196  # 205 reads as 0.1961 occupied: a free_thresh of 0.2 makes it free
MAX_PIXELS = 2**30  # 1.6 km square at 5 cm: a map that spans more has lost its pose

_GREY = np.full(256, GREY_UNKNOWN, dtype=np.uint8)
_GREY[: int(FREE_THRESH * 100) + 1] = WHITE_FREE
_GREY[int(OCCUPIED_THRESH * 100) : 101] = BLACK_OCCUPIED
_GREY_OF = _GREY.tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """Pixels of a map; the first row of the first band is the top, the largest y.

    (x_min_m, y_min_m) is the lower left corner of the lower left pixel in the map frame.
    """

    width: int
    height: int
    cell_m: float
    x_min_m: float
    y_min_m: float
    bands: Callable[[], Iterator[Pixels]]  # each (rows, width); may be walked through more than once


def to_pixels(cells: npt.NDArray[np.int8]) -> Pixels:
    """(H, W) occupancy, row 0 lowest -> (H, W) grey, row 0 on top; read-only."""
    pixels = cells[::-1].tobytes().translate(_GREY_OF)  # in half the time of an index by cells
    return np.frombuffer(pixels, np.uint8).reshape(cells.shape)


def picture_of_grid(grid: Grid) -> Picture:
    def bands() -> Iterator[Pixels]:
        yield to_pixels(grid.cells)

    height, width = grid.cells.shape
    return Picture(width, height, grid.cell_m, grid.x_min_m, grid.y_min_m, bands)


def picture_of_tiles(tiles: Sequence[TileUpdate]) -> Picture:
    """The finest level of `tiles`, one row of tiles a band. Raises StorageError beyond MAX_PIXELS."""
    finest = {(tile.ix, tile.iy): tile for tile in tiles if tile.level == 0}
    if not finest:
        raise ValueError("no tile of level 0 to make a picture of")
    first = next(iter(finest.values()))
    return picture_of_squares(
        finest.keys(), len(first.cells), first.cell_m, lambda key: to_pixels(finest[key].cells)
    )


def picture_of_squares(
    keys: Collection[tuple[int, int]], edge: int, cell_m: float, pixels: Callable[[tuple[int, int]], Pixels]
) -> Picture:
    """One row of tiles (ix, iy) a band, unknown where there is none. Raises StorageError beyond MAX_PIXELS.

    pixels   (edge, edge) of a tile, row 0 on top
    """
    low_x, high_x = min(ix for ix, _ in keys), max(ix for ix, _ in keys)
    low_y, high_y = min(iy for _, iy in keys), max(iy for _, iy in keys)
    width, height = (high_x - low_x + 1) * edge, (high_y - low_y + 1) * edge
    if width * height > MAX_PIXELS:
        raise StorageError(
            f"the map spans {width * cell_m:.0f} x {height * cell_m:.0f} m, {width * height} pixels "
            f"(at most {MAX_PIXELS}); has the pose run away?"
        )

    def bands() -> Iterator[Pixels]:
        for iy in range(high_y, low_y - 1, -1):
            band = np.full((edge, width), GREY_UNKNOWN, np.uint8)
            for ix in range(low_x, high_x + 1):
                if (ix, iy) in keys:
                    at = (ix - low_x) * edge
                    band[:, at : at + edge] = pixels((ix, iy))
            yield band

    return Picture(width, height, cell_m, low_x * edge * cell_m, low_y * edge * cell_m, bands)
