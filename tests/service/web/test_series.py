"""Rows of figures, one a second."""

from dataclasses import replace

import numpy as np
import pytest

from service.encoding import Status, decode_pose, encode_pose
from service.web.series import FigureRows
from tests.browser.scene import Scene


def mapping(state: str = "ok", level: int = 0, **values: str) -> Status:
    return Status("mapping", level, state, {"state": state, **values})


def pose(covariance: np.ndarray, speed_mps: float = 1.0):
    output = replace(Scene().output(0.0), covariance=covariance, twist_base=(speed_mps, 0.0, 0.0))
    return decode_pose(encode_pose(output, 0).payload)


def test_sigma_is_the_longest_half_axis_of_the_least_certain_pose():
    rows = FigureRows()
    rows.row(0.0)
    turned = np.array([[2.5e-4, 1.5e-4, 0.0], [1.5e-4, 2.5e-4, 0.0], [0.0, 0.0, 1e-6]])  # axes 2 and 1 cm
    rows.put_pose(pose(turned))
    rows.put_pose(pose(np.diag([1e-4, 1e-4, 1.0]), speed_mps=-0.5))
    rows.put_health([mapping()])
    assert rows.row(1.0).figures == {"sigma_m": pytest.approx(0.02), "speed_mps": -0.5}


def test_dropped_scans_count_since_the_row_before_and_a_restart_takes_none_away():
    rows = FigureRows()
    rows.row(0.0)
    dropped = []
    for second, total in enumerate((5, 7, 7, 1), start=1):
        rows.put_health([mapping(scans_dropped=str(total))])
        dropped.append(rows.row(float(second)).figures["dropped"])
    assert dropped == [0.0, 2.0, 0.0, 0.0]


def test_the_worst_state_of_a_row_remains_and_the_next_row_begins_with_its_own():
    rows = FigureRows(period_s=10.0)
    rows.row(0.0)
    for status in (mapping(), mapping("lost", 2), mapping()):
        rows.put_health([status])
    assert rows.row(5.0) is None
    first = rows.row(10.0)
    assert (first.state, first.level) == ("lost", 2)
    rows.put_health([mapping()])
    assert rows.row(20.0).state == "ok"


@pytest.mark.parametrize("text", ["", "nan", "inf", "many"])
def test_a_figure_that_is_no_number_is_left_out(text):
    rows = FigureRows()
    rows.row(0.0)
    rows.put_health([mapping(inlier_ratio=text), Status("sensor/front", 0, "ok", {"rate_hz": text})])
    assert rows.row(1.0).figures == {}
