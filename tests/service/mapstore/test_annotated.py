import numpy as np
import pytest

from service.mapstore.annotated import PALETTE, annotated
from service.mapstore.picture import picture_of_grid
from service.outputs import FREE, OCCUPIED, UNKNOWN, Grid

CELL_M, X_MIN_M, Y_MIN_M = 0.05, -20.0, -15.0


@pytest.fixture
def picture():
    """A room of 10 x 6 m with walls, in a map of 40 x 30 m."""
    cells = np.full((600, 800), UNKNOWN, dtype=np.int8)
    cells[240:360, 340:540] = OCCUPIED
    cells[241:359, 341:539] = FREE
    return picture_of_grid(Grid(1, CELL_M, X_MIN_M, Y_MIN_M, cells))


def pixels_of(picture):
    return np.vstack(list(picture.bands()))


def at(picture, x_m, y_m):
    """Row and column of a place."""
    top_m = picture.y_min_m + picture.height * picture.cell_m
    return int((top_m - y_m) / picture.cell_m), int((x_m - picture.x_min_m) / picture.cell_m)


def test_what_is_unknown_around_is_cut_off_and_the_rest_keeps_its_place(picture):
    shown = annotated(picture)
    pixels, whole = pixels_of(shown), pixels_of(picture)
    assert pixels.shape == (shown.height, shown.width)
    assert shown.width == 200 + 24
    assert 120 < shown.height < 180
    marked = np.isin(pixels, list(PALETTE))
    for x_m, y_m in ((-2.9, -2.9), (6.9, 2.9), (-2.975, 1.0), (3.0, 2.975), (4.0, -2.0)):
        row, column = at(shown, x_m, y_m)
        assert not marked[row, column]
        assert pixels[row, column] == whole[at(picture, x_m, y_m)]


def test_a_map_of_which_nothing_is_known_is_shown_whole():
    empty = picture_of_grid(Grid(1, CELL_M, 0.0, 0.0, np.full((10, 10), UNKNOWN, dtype=np.int8)))
    assert annotated(empty).width >= 10
