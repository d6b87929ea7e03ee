import math

import numpy as np
import pytest

from service.mapper.papers.owolm_eskf.building_axes import building_axes
from tests.service.mapper.drives import ROOM, scan_at, standing


def points_of(turn_deg: float, walls=ROOM) -> np.ndarray:
    """What a scan of the room looks like from a base that is turned by so much."""
    scan = scan_at(walls, standing, 0, 0, np.random.default_rng(1), 0.01)
    angle = scan.first_angle_rad + np.arange(len(scan.range_m)) * scan.angle_step_rad - math.radians(turn_deg)
    seen = np.isfinite(scan.range_m)
    return (scan.range_m[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))[seen]


def axes_deg(xy: np.ndarray) -> float:
    axes = building_axes(xy, np.full(len(xy), 0.3), 0.35)
    assert axes is not None
    return math.degrees(axes)


@pytest.mark.parametrize("turn_deg", [0.0, 10.0, 30.0, 45.0, 80.0])
def test_the_walls_directions_are_found_however_the_vehicle_stands(turn_deg):  # B3 B18
    apart = (axes_deg(points_of(turn_deg)) - axes_deg(points_of(0.0)) + turn_deg + 45.0) % 90.0 - 45.0
    assert abs(apart) < 0.2
    assert -45.0 <= axes_deg(points_of(turn_deg)) <= 45.0


def test_where_nothing_stands_out_nothing_is_reported():
    angle = np.linspace(-2.0, 2.0, 500)
    circle = 5.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    assert building_axes(circle, np.full(500, 0.3), 0.35) is None
    assert building_axes(circle[:5], np.full(5, 0.3), 0.35) is None
    assert building_axes(np.zeros((20, 2)), np.full(20, 0.3), 0.35) is None
