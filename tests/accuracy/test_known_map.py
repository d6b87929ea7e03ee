import math
from dataclasses import replace

import numpy as np
import pytest

from service.geometry.se2 import SE2
from simulators.worlds import build_world
from tests.accuracy.known_map import fisher_information
from tests.simulated import LMS100_50HZ


def test_bound_in_the_square_room_is_the_published_formula():
    """Against the sum over beams in closed form: dr/dt = -n / (n . d), dr/dtheta = r tan(incidence)."""
    laser = replace(LMS100_50HZ, mounting=SE2())
    information = np.zeros((3, 3))
    for k in range(laser.beams):
        angle = math.radians(laser.first_deg + k * laser.step_deg)
        d = np.array([math.cos(angle), math.sin(angle)])
        axis = int(np.argmax(np.abs(d)))
        n = np.zeros(2)
        n[axis] = math.copysign(1.0, d[axis])
        range_m = 5.0 / abs(d[axis])
        by_turn = range_m * (d[0] * n[1] - d[1] * n[0]) / (n @ d)
        j = np.array([*(-n / (n @ d)), -by_turn])
        information += np.outer(j, j) / laser.model.sigma_m**2
    found = np.linalg.inv(fisher_information(build_world("room"), laser, SE2()))
    # three beams look into corners, where the range has no derivative, and are left out of what is cast
    np.testing.assert_allclose(
        np.sqrt(np.diag(found)), np.sqrt(np.diag(np.linalg.inv(information))), rtol=0.02
    )
    assert math.degrees(math.sqrt(found[2, 2])) == pytest.approx(0.0093, abs=0.0002)
