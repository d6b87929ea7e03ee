"""Maximum likelihood pose of a point cloud in a known map near an initial pose, by its beams."""

import math

import numpy as np

from service.kernels.arrays import Float64_1D, Float64_2D
from service.kernels.beam_likelihood import KnownGround, weigh_ends, weigh_paths
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
    """Log-likelihood ratio of a pose by the end points and the paths of the beams, nats.

    The paths can only reduce it: where the end points alone do not reach `least`, the paths are not
    evaluated, and the result is an upper bound below `least`.

    shares   (N,) float64   weight of each end point
    at_end, along_beam   (N,) float64   out, as from weigh_ends and weigh_paths
    """
    weigh_ends(xy, normals, pose, known, at_end)
    total = 0.0
    for i in range(xy.shape[0]):
        total += shares[i] * at_end[i]
    if total < least:
        along_beam[:] = 0.0
        return total
    return total + weigh_paths(xy, sensors, pose, known, number, least - total, along_beam)


@kernel(Float64_2D, Float64_2D, Float64_2D, Float64_1D, Float64_1D, KnownGround, int, Float64_1D, float)
def hill_climb(xy, normals, sensors, shares, pose, known, number, first, least):
    """Move a pose to a local maximum of the likelihood, by coordinate steps that are halved.

    pose     (3,) float64   in: initial, out: final, in the map
    number   int            of the first pose evaluated, see weigh_paths; those after it count up
    first    (3,) float64   longest steps, m, m, rad
    least    float          shortest steps over the longest
    Returns (nats at the final pose, poses evaluated).
    Source: Hooke and Jeeves, Direct search solution of numerical and statistical problems, 1961.
    """
    at_end, along_beam = np.empty(xy.shape[0]), np.empty(xy.shape[0])
    best = evidence_of_beams(xy, normals, sensors, shares, pose, known, number, -math.inf, at_end, along_beam)
    evaluated = 1
    trial, next_pose = np.empty(3), np.empty(3)
    scale = 1.0
    while scale >= least:
        next_best = best
        for axis in range(3):
            for sign in (-1.0, 1.0):
                copy_vector(pose, trial)
                trial[axis] += sign * scale * first[axis]
                evidence = evidence_of_beams(
                    xy,
                    normals,
                    sensors,
                    shares,
                    trial,
                    known,
                    number + evaluated,
                    next_best,
                    at_end,
                    along_beam,
                )
                evaluated += 1
                if evidence > next_best:
                    next_best = evidence
                    copy_vector(trial, next_pose)
        if next_best > best:
            best = next_best
            copy_vector(next_pose, pose)
        else:
            scale *= 0.5
    return best, evaluated
