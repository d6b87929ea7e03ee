"""The likeliest pose of a cloud of points in a known map near another one, by the beams that end in them."""

import numpy as np
from numba import njit

from service.kernels.beam_likelihood import weigh_beams
from service.kernels.linear3 import copy_vector


@njit(cache=True, nogil=True)
def evidence_of_beams(xy, normals, sensors, shares, pose, known, number, at_end, on_way):
    """Nats that speak for a pose, as weigh_beams gives them.

    shares   (N,) float64   what the end of each beam counts
    """
    weigh_beams(xy, normals, sensors, pose, known, number, at_end, on_way)
    total = 0.0
    for i in range(xy.shape[0]):
        total += shares[i] * at_end[i] + on_way[i]
    return total


@njit(cache=True, nogil=True)
def climb(xy, normals, sensors, shares, pose, known, number, first, least):
    """Go from a pose to the likeliest one near it: a step along the axis that gains most, while one gains;
    then steps of half the length.

    pose     (3,) float64   in: where to start, out: where it ended, in the map
    number   int            of the first pose asked, as weigh_beams takes it; those after it count on
    first    (3,) float64   longest steps, m, m, rad
    least    float          so many times the longest steps are the shortest
    Returns (nats at the end, poses asked).
    Source: Hooke and Jeeves, Direct search solution of numerical and statistical problems, 1961.
    """
    at_end, on_way = np.empty(xy.shape[0]), np.empty(xy.shape[0])
    best = evidence_of_beams(xy, normals, sensors, shares, pose, known, number, at_end, on_way)
    asked = 1
    trial, next_pose = np.empty(3), np.empty(3)
    scale = 1.0
    while scale >= least:
        next_best = best
        for axis in range(3):
            for sign in (-1.0, 1.0):
                copy_vector(pose, trial)
                trial[axis] += sign * scale * first[axis]
                evidence = evidence_of_beams(
                    xy, normals, sensors, shares, trial, known, number + asked, at_end, on_way
                )
                asked += 1
                if evidence > next_best:
                    next_best = evidence
                    copy_vector(trial, next_pose)
        if next_best > best:
            best = next_best
            copy_vector(next_pose, pose)
        else:
            scale *= 0.5
    return best, asked
