import math

import numpy as np
import pytest

from service.mapper.graph.loops import BLIND_M, loop_of


def sigmas(hessian: np.ndarray, direction_rad: float, turned_rad: float = 0.0) -> tuple[float, float, float]:
    """Of the loop: along a direction of `of`, across it, and of the heading."""
    covariance = loop_of(3, 90, np.array([1.0, 2.0, turned_rad]), hessian, 0.9).covariance
    along_rad = direction_rad - turned_rad  # the covariance is in the axes of `to`
    along = np.array([math.cos(along_rad), math.sin(along_rad), 0.0])
    across = np.array([-math.sin(along_rad), math.cos(along_rad), 0.0])
    return (
        math.sqrt(along @ covariance @ along),
        math.sqrt(across @ covariance @ across),
        math.sqrt(covariance[2, 2]),
    )


def corridor(direction_rad: float, along_sigma_m: float) -> np.ndarray:
    """Walls on both sides, and a little that seems to say how far along; it pulls at the heading, too."""
    turn = np.eye(3)
    turn[:2, 0] = math.cos(direction_rad), math.sin(direction_rad)
    turn[:2, 1] = -math.sin(direction_rad), math.cos(direction_rad)
    information = np.diag([2.0 / along_sigma_m**2, 2.0 / 0.003**2, 2.0 / 0.001**2])
    information[0, 2] = information[2, 0] = 0.3 * math.sqrt(information[0, 0] * information[2, 2])
    return np.ascontiguousarray(turn @ information @ turn.T)


@pytest.mark.parametrize("direction_rad", [0.0, 0.7, 2.4])
def test_along_a_bare_corridor_a_loop_says_nothing(direction_rad: float) -> None:
    along, across, heading = sigmas(corridor(direction_rad, 2.0 * BLIND_M), direction_rad, turned_rad=0.4)
    assert along > 100.0
    assert across < 0.01
    assert heading < 0.003


def test_a_wall_at_the_end_counts() -> None:
    along, across, _ = sigmas(corridor(0.3, 0.4 * BLIND_M), 0.3)
    assert along == pytest.approx(0.4 * BLIND_M, rel=0.15)
    assert across < 0.01
