"""Areas and lines, and the cells that they take."""

import numpy as np
import pytest
from scipy import ndimage

from service.geometry.polygons import area_m2, cells_along, cells_inside, is_inside

SQUARE = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)])
HOOK = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 3.0), (2.0, 3.0), (2.0, 1.0), (0.0, 1.0)])


@pytest.mark.parametrize("turned", [1, -1])
def test_points_within_an_outline_are_inside_in_either_direction(turned):
    xy = np.array([(0.5, 0.5), (2.5, 2.5), (1.0, 2.0), (-0.1, 0.5), (2.5, 3.1), (3.1, 0.5)])
    assert is_inside(xy, HOOK[::turned]).tolist() == [True, True, False, False, False, False]
    assert area_m2(HOOK[::turned]) == pytest.approx(5.0)


def test_the_cells_of_an_area_are_those_whose_centre_it_holds():
    cells = cells_inside(SQUARE - (0.5, 0.0), 0.5)
    assert cells.tolist() == [[row, column] for row in range(2) for column in range(-1, 3)]


def test_half_of_random_points_lie_in_half_of_the_square():
    xy = np.random.default_rng(3).uniform(0.0, 1.0, (20_000, 2))
    triangle = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)])
    np.testing.assert_array_equal(is_inside(xy, triangle), xy.sum(axis=1) < 1.0)


@pytest.mark.parametrize("end", [(4.0, 0.0), (3.0, 2.9), (0.3, -4.0), (2.0, 0.7)])
def test_no_step_between_cells_crosses_a_line(end):
    """Ground on both sides of a line across a field is two parts, diagonal steps allowed."""
    towards = np.array(end) / np.hypot(*end)
    cells = cells_along(np.stack((-10.0 * towards, 10.0 * towards)), 0.1)
    field = np.ones((40, 40), np.bool_)
    row, column = (cells + 20).T
    within = (row >= 0) & (row < 40) & (column >= 0) & (column < 40)
    field[row[within], column[within]] = False
    assert ndimage.label(field, structure=np.ones((3, 3)))[1] == 2
    assert len(cells) < 2.6 * 20.0 / 0.1


def test_a_line_goes_through_all_of_its_points():
    corners = np.array([(0.05, 0.05), (1.05, 0.05), (1.05, 1.05)])
    cells = {tuple(cell) for cell in cells_along(corners, 0.1).tolist()}
    assert {(0, 0), (0, 10), (10, 10), (5, 10)} <= cells
    assert (5, 5) not in cells
