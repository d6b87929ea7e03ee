"""The mechanisation against closed forms, and its linearised error against finite differences."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.kernels.strapdown import STRAPDOWN_STATES, strapdown_step

UP = np.array([0.0, 0.0, -9.81])


def navigate(start, samples, time_s, gravity=UP):
    position, velocity, rotation = (part.copy() for part in start)
    transition = np.eye(STRAPDOWN_STATES)
    step = np.empty((STRAPDOWN_STATES, STRAPDOWN_STATES))
    for force, rate in samples:
        strapdown_step(position, velocity, rotation, force, rate, gravity, time_s, step)
        transition = step @ transition
    return position, velocity, rotation, transition


def a_start(noise):
    return (
        noise.standard_normal(3),
        noise.standard_normal(3),
        Rotation.from_rotvec(0.1 * noise.standard_normal(3) + [0.0, 0.0, 1.0]).as_matrix(),
    )


def test_errors_propagate_by_the_transition():  # B6 B7 B8
    """15 states, each pushed a little, half a second of turning and accelerating: F's signs and frames."""
    noise = np.random.default_rng(3)
    start = a_start(noise)
    samples = [(np.array([1.0, -0.5, 9.6]), np.array([0.1, -0.05, 0.8]))] * 100
    position, velocity, rotation, transition = navigate(start, samples, 0.005)
    assert transition.shape == (15, 15)
    small = 1e-6
    for state in range(STRAPDOWN_STATES):
        push = np.zeros(STRAPDOWN_STATES)
        push[state] = small
        moved = (
            start[0] + push[:3],
            start[1] + push[3:6],
            Rotation.from_rotvec(push[6:9]).as_matrix() @ start[2],
        )
        felt = [(force - push[9:12], rate - push[12:]) for force, rate in samples]
        p, v, r, _ = navigate(moved, felt, 0.005)
        error = np.concatenate(
            [p - position, v - velocity, Rotation.from_matrix(r @ rotation.T).as_rotvec(), push[9:]]
        )
        np.testing.assert_allclose(error / small, transition[:, state], atol=0.02, err_msg=str(state))


DOWN_FROM_UP = np.diag([1.0, -1.0, -1.0])  # pi about x: forward-left-up to forward-right-down


def test_north_east_down_is_the_same_turned_about_x():  # B9
    noise = np.random.default_rng(1)
    start = a_start(noise)
    samples = [(noise.standard_normal(3) - UP, 0.5 * noise.standard_normal(3)) for _ in range(200)]
    position, velocity, rotation, _ = navigate(start, samples, 0.005)
    turn = DOWN_FROM_UP
    down = navigate(
        (turn @ start[0], turn @ start[1], turn @ start[2] @ turn),
        [(turn @ force, turn @ rate) for force, rate in samples],
        0.005,
        gravity=-UP,
    )
    np.testing.assert_allclose(turn @ down[0], position, atol=1e-12)
    np.testing.assert_allclose(turn @ down[1], velocity, atol=1e-12)
    np.testing.assert_allclose(turn @ down[2] @ turn, rotation, atol=1e-12)
    yaw, yaw_down = (math.atan2(r[1, 0], r[0, 0]) for r in (rotation, down[2]))
    assert yaw_down == pytest.approx(-yaw)  # clockwise seen from above
