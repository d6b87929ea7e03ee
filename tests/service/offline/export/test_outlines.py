import numpy as np
import pytest

from service.mapstore.picture import picture_of_grid
from service.offline.export.outlines import TOLERANCE_CELLS, occupied_cells, occupied_points, outlines
from service.outputs import FREE, OCCUPIED, Grid

CELL_M, X_MIN_M, Y_MIN_M = 0.5, -3.0, 2.0


def picture(rows):
    """Rows from above, # occupied."""
    cells = np.array([[OCCUPIED if mark == "#" else FREE for mark in row] for row in rows], dtype=np.int8)[
        ::-1
    ]
    return picture_of_grid(Grid(1, CELL_M, X_MIN_M, Y_MIN_M, cells))


def area_m2(points):
    """By the shoelace formula; positive counter-clockwise."""
    x, y = points.T
    return 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


def test_a_hole_goes_round_in_the_other_direction():
    outer, hole = sorted(outlines(picture(["#####", "#...#", "#...#", "#...#", "#####"])), key=area_m2)[::-1]
    assert sorted(map(tuple, outer.tolist())) == [(-3.0, 2.0), (-3.0, 4.5), (-0.5, 2.0), (-0.5, 4.5)]
    assert area_m2(outer) == pytest.approx(25 * CELL_M**2)
    assert area_m2(hole) == pytest.approx(-9 * CELL_M**2)


def test_cells_that_touch_by_a_corner_are_two():
    assert outlines(picture(["..."])) == []
    assert occupied_points(picture(["..."])).shape == (0, 2)
    loops = outlines(picture(["#.", ".#"]))
    assert [area_m2(loop) for loop in loops] == [pytest.approx(CELL_M**2)] * 2


def test_a_slanting_wall_becomes_straight_and_stays_near_its_cells():
    rows = ["." * (39 - k // 3) + "###" + "." * (k // 3) for k in range(60)]
    wall = outlines(picture(rows))
    assert len(wall) == 1
    assert len(wall[0]) < 12
    cells = occupied_cells(picture(rows))
    assert area_m2(wall[0]) == pytest.approx(cells.sum() * CELL_M**2, rel=0.1)
    middles = occupied_points(picture(rows))
    away = np.abs(middles[None, :, :] - wall[0][:, None, :]).sum(axis=2).min(axis=1)
    assert away.max() <= (TOLERANCE_CELLS + 1.0) * CELL_M


@pytest.mark.parametrize("seed", range(5))
def test_signed_areas_add_up_to_the_cells_where_nothing_is_thinned(seed, monkeypatch):
    monkeypatch.setattr("service.offline.export.outlines.TOLERANCE_CELLS", 1e-9)
    rows = np.random.default_rng(seed).choice(list("#."), size=(23, 31))
    assert sum(map(area_m2, outlines(picture(rows)))) == pytest.approx((rows == "#").sum() * CELL_M**2)
