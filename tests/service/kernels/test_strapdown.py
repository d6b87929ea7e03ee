"""The mechanisation against closed forms, and its linearised error against finite differences."""

import numpy as np
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
