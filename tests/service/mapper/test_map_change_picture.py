"""Changed cells as a picture, without a drive: see test_map_changes.py for how they are found."""

import numpy as np
import pytest

from service.mapper.map_changes import MapChanges


def changes(cells: list[tuple[int, int, bool]]) -> MapChanges:
    """column, row, whether it is new; cells of 0.1 m."""
    at = np.array([(column, row) for column, row, _ in cells], np.float64).reshape(-1, 2)
    stamps = np.zeros(len(cells), np.int64)
    return MapChanges(
        0.1, (at + 0.5) * 0.1, np.array([c[2] for c in cells], np.bool_), stamps, stamps, stamps
    )


def test_the_picture_holds_what_is_new_and_what_is_gone_and_no_more():
    grid = changes([(-3, 7, True), (-1, 8, False), (-2, 7, True)]).as_grid()
    assert (grid.x_min_m, grid.y_min_m, grid.cell_m) == pytest.approx((-0.3, 0.7, 0.1))
    assert grid.cells.tolist() == [[100, 100, -1], [-1, -1, 0]]


def test_where_nothing_has_changed_the_picture_is_empty():
    assert changes([]).as_grid().cells.shape == (0, 0)


def test_other_cells_or_another_change_of_them_differ():
    one = changes([(1, 1, True)])
    assert one.has_same_cells(changes([(1, 1, True)]))
    assert not one.has_same_cells(changes([(1, 1, False)]))
    assert not one.has_same_cells(changes([(1, 2, True)]))
    assert not one.has_same_cells(None)
