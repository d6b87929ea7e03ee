import math

import numpy as np
import pytest

from service.kernels.maximum_likelihood_pose import evidence_of_beams, hill_climb
from tests.service.kernels.test_beam_likelihood import mapped

FIRST, LEAST = np.array([0.06, 0.06, 0.012]), 1.0 / 16.0


def seen_at(pose, noise):
    """Ends on the wall, with normals, in the frame of a base that has a pose in the map."""
    ends = np.column_stack((3.05 + 0.005 * noise.standard_normal(120), np.linspace(-1.4, 1.4, 120)))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turn = np.array([[c, -s], [s, c]])
    return (ends - pose[:2]) @ turn, np.tile([*(np.array([-1.0, 0.0]) @ turn), 1.0], (120, 1))


def evaluated_at(pose, xy, normals, shares, known, number, least=-math.inf):
    at_end, along_beam = np.empty(120), np.empty(120)
    evidence = evidence_of_beams(
        xy, normals, np.zeros((120, 2)), shares, pose, known, number, least, at_end, along_beam
    )
    return evidence, at_end, along_beam


def climbed(start, truth, shares, noise):
    known = mapped()
    xy, normals = seen_at(truth, noise)
    sensors, pose = np.zeros((120, 2)), np.array(start)
    best, evaluated = hill_climb(xy, normals, sensors, shares, pose, known, 1, FIRST, LEAST)
    evidence, at_end, along_beam = evaluated_at(pose, xy, normals, shares, known, evaluated + 1)
    assert best == evidence == pytest.approx(float(shares @ at_end + along_beam.sum()))
    return pose, best, evaluated


def test_a_climb_ends_at_the_wall_and_along_it_where_it_ends():
    truth = (0.1, -0.05, 0.04)
    start = (0.19, 0.05, 0.015)
    pose, _, evaluated = climbed(start, truth, np.ones(120), np.random.default_rng(1))
    assert pose[2] == pytest.approx(truth[2], abs=0.004)
    across = pose[0] - truth[0]  # of the wall; along it only its ends fix the position
    assert abs(across) < 0.012
    assert abs(pose[1] - truth[1]) < 0.15
    assert evaluated < 200


def test_where_the_ends_alone_are_not_enough_their_sum_is_reported():
    """From beyond the wall: every beam goes through it and ends on its back."""
    known, truth = mapped(), np.zeros(3)
    xy, normals = seen_at(truth, np.random.default_rng(1))
    beyond = np.array([0.6, 0.0, 0.0])
    evidence, at_end, along_beam = evaluated_at(beyond, xy, normals, np.ones(120), known, 1)
    assert (along_beam < 0.0).any()
    assert evidence < at_end.sum()
    bound, _, skipped = evaluated_at(beyond, xy, normals, np.ones(120), known, 2, at_end.sum() + 1.0)
    assert bound == pytest.approx(at_end.sum())
    assert (skipped == 0.0).all()
