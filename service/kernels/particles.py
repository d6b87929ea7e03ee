"""Weights of particles, and resampling."""

import math

from service.kernels.arrays import Float64_1D, Int64_1D
from service.kernels.compiled import kernel


@kernel(Float64_1D, Float64_1D)
def normalise_weights(log_weights, weights):
    """Normalise weights; returns the effective number of particles.

    log_weights   (N,) float64   in and out: the largest becomes 0, which keeps them bounded
    weights       (N,) float64   out: sum 1
    Returns 1 / sum of squares: N for equal weights, 1 where one particle has all the weight.
    Source: Doucet, Godsill, Andrieu 2000, eq. 51.
    """
    largest = log_weights[0]
    for k in range(1, log_weights.shape[0]):
        largest = max(largest, log_weights[k])
    total = 0.0
    for k in range(log_weights.shape[0]):
        log_weights[k] -= largest
        weights[k] = math.exp(log_weights[k])
        total += weights[k]
    squares = 0.0
    for k in range(weights.shape[0]):
        weights[k] /= total
        squares += weights[k] * weights[k]
    return 1.0 / squares


@kernel(Float64_1D, float, Int64_1D)
def resample(weights, first, chosen):
    """Low-variance resampling with one random number.

    weights   (N,) float64   sum 1
    first     float          random, in [0, 1)
    chosen    (N,) int64     out: index of the particle that each one becomes; rising
    Source: Thrun, Burgard, Fox, Probabilistic Robotics, table 4.4.
    """
    count = weights.shape[0]
    k = 0
    reached = weights[0]
    for n in range(count):
        at = (n + first) / count
        while reached < at and k < count - 1:
            k += 1
            reached += weights[k]
        chosen[n] = k
