import math

import numpy as np
import pytest

from service.mapper.graph.model.loops import FLOOR, far_from_loops, loop_of


def sigmas(
    information: np.ndarray, direction_rad: float, turned_rad: float = 0.0
) -> tuple[float, float, float]:
    """Of the loop: along a direction of `of`, across it, and of the heading."""
    covariance = loop_of(3, 90, np.array([1.0, 2.0, turned_rad]), information, 0.9).covariance
    along_rad = direction_rad - turned_rad  # the covariance is in the axes of `to`
    along = np.array([math.cos(along_rad), math.sin(along_rad), 0.0])
    across = np.array([-math.sin(along_rad), math.cos(along_rad), 0.0])
    return (
        math.sqrt(along @ covariance @ along),
        math.sqrt(across @ covariance @ across),
        math.sqrt(covariance[2, 2]),
    )


def corridor(direction_rad: float, along_sigma_m: float) -> np.ndarray:
    """Information of walls on both sides, and of the direction along them."""
    turn = np.eye(3)
    turn[:2, 0] = math.cos(direction_rad), math.sin(direction_rad)
    turn[:2, 1] = -math.sin(direction_rad), math.cos(direction_rad)
    information = np.diag([1.0 / along_sigma_m**2, 1.0 / 0.003**2, 1.0 / 0.001**2])
    return np.ascontiguousarray(turn @ information @ turn.T)


@pytest.mark.parametrize("direction_rad", [0.0, 0.7, 2.4])
def test_a_direction_that_no_wall_fixes_stays_open(direction_rad: float) -> None:
    along, across, heading = sigmas(corridor(direction_rad, math.inf), direction_rad, turned_rad=0.4)
    assert along == pytest.approx(100.0, rel=0.01)
    assert across == pytest.approx(math.sqrt(0.003**2 + FLOOR[1, 1]), rel=0.01)
    assert heading == pytest.approx(math.sqrt(0.001**2 + FLOOR[2, 2]), rel=0.01)


def test_a_wall_at_the_end_counts_with_its_information() -> None:
    along, across, _ = sigmas(corridor(0.3, 0.4), 0.3)
    assert along == pytest.approx(0.4, rel=0.01)
    assert across < 0.01


def test_no_loop_is_more_certain_than_the_covariance_floor() -> None:
    along, across, heading = sigmas(1e12 * np.eye(3), 0.3, turned_rad=0.4)
    assert (along, across, heading) == pytest.approx(np.sqrt(np.diag(FLOOR)), rel=1e-3)


def test_positions_along_the_path_without_a_loop() -> None:
    at_m = np.arange(0.0, 20.0, 2.0)
    assert far_from_loops(at_m, np.array([15.0, 4.5]), 2.0).tolist() == [0.0, 2.0, 8.0, 10.0, 12.0, 18.0]
    assert far_from_loops(at_m, np.empty(0), 2.0).tolist() == at_m.tolist()
