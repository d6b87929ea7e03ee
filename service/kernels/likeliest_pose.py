"""The likeliest pose of a cloud of points in a known map near another one, by the beams that end in them."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.beam_likelihood import KnownGround, weigh_ends, weigh_ways
from service.kernels.compiled import kernel
from service.kernels.linear3 import copy_vector


@kernel(
    Float64_2D,
    Float64_2D,
    Float64_2D,
    Float64_1D,
    Float64_1D,
    KnownGround,
    int,
    float,
    Float64_1D,
    Float64_1D,
)
def evidence_of_beams(xy, normals, sensors, shares, pose, known, number, least, at_end, along_beam):
    """Nats that speak for a pose: of the beams' ends and ways.

    Ways only take away: where the ends alone do not reach `least`, no way is asked, and what is given is less
    than `least`, but no less than the evidence.

    shares   (N,) float64   what the end of each beam counts
    at_end, on_way   (N,) float64   out, as weigh_ends and weigh_ways give them
    """
    weigh_ends(xy, normals, pose, known, at_end)
    total = 0.0
    for i in range(xy.shape[0]):
        total += shares[i] * at_end[i]
    if total < least:
        along_beam[:] = 0.0
        return total
    return total + weigh_ways(xy, sensors, pose, known, number, least - total, along_beam)


@kernel(Float64_2D, Float64_2D, Float64_2D, Float64_1D, Float64_1D, KnownGround, int, Float64_1D, float)
def climb(xy, normals, sensors, shares, pose, known, number, first, least):
    """Go from a pose to the likeliest one near it: a step along the axis that gains most, while one gains;
    then steps of half the length.

    pose     (3,) float64   in: where to start, out: where it ended, in the map
    number   int            of the first pose asked, as weigh_ways takes it; those after it count on
    first    (3,) float64   longest steps, m, m, rad
    least    float          so many times the longest steps are the shortest
    Returns (nats at the end, poses asked).
    Source: Hooke and Jeeves, Direct search solution of numerical and statistical problems, 1961.
    """
    at_end, along_beam = np.empty(xy.shape[0]), np.empty(xy.shape[0])
    best = evidence_of_beams(xy, normals, sensors, shares, pose, known, number, -math.inf, at_end, along_beam)
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
                    xy, normals, sensors, shares, trial, known, number + asked, next_best, at_end, along_beam
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
