import numpy as np
import pytest

from service.mapstore.annotated import AXIS_X, AXIS_Y, INK, PALETTE, PATH, annotated, scale_bar_m
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


def test_the_path_the_origin_and_the_bar_are_where_they_belong(picture):
    path = np.array([(-2.0, 2.0), (-2.0, -2.0), (6.0, -2.0)])
    other = np.array([(4.0, 2.0), (6.0, 2.0)])
    shown = annotated(picture, [path, other])
    pixels = pixels_of(shown)
    assert PATH not in pixels[:, at(shown, 1.5, 0.0)[1]][: at(shown, 0.0, -1.5)[0]]  # no line joins the two
    for x_m, y_m in ((-2.0, 1.0), (-2.0, -1.9), (0.0, -2.0), (5.9, -2.0), (5.0, 2.0)):
        row, column = at(shown, x_m, y_m)
        assert PATH in pixels[row - 1 : row + 2, column - 1 : column + 2]
    row, column = at(shown, 0.9, 0.0)
    assert AXIS_X in pixels[row - 1 : row + 2, column]
    row, column = at(shown, 0.0, 0.9)
    assert AXIS_Y in pixels[row, column - 1 : column + 2]
    rows, columns = np.nonzero(pixels == INK)
    assert rows.min() > at(shown, 0.0, -3.0)[0]  # below the room
    assert columns.max() - columns.min() == 2.0 / CELL_M  # 2 m


@pytest.mark.parametrize(
    ("width_m", "bar_m"), [(4.0, 1.0), (7.9, 1.0), (8.0, 2.0), (45.0, 10.0), (1600.0, 200.0), (0.5, 0.1)]
)
def test_the_bar_has_a_round_length(width_m, bar_m):
    assert scale_bar_m(width_m) == pytest.approx(bar_m)
